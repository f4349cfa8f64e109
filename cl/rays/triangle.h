/* A triangle before a pixel: whether the pixel's ray meets it, where, and how its corners share in that place.
 *
 * Reference: Woop, Benthin, Wald 2013, "Watertight ray/triangle intersection".
 *
 *               c            Corners count from the ray: x to the right, y up, in mm at the depth of each.
 *              / \           The ray meets the triangle where it lies on the same side of a -> b, b -> c and c -> a.
 *             /   \          A side is the sign of ax by - ay bx, found without rounding.  A ray on an edge counts as
 *            /  +  \         a little to the right of it, and then a little above, so that of two triangles with that
 *           a-------b        edge one is met.  Corners of several triangles are the same numbers in all of them: a
 *                            closed surface has no gap, and no pixel of a flat one is drawn twice.
 *
 * No product and sum become one from here on: what is decided is the same on every device. */
#ifndef CLRECON_TRIANGLE_H
#define CLRECON_TRIANGLE_H

#include "rays/eye.h"

#define NOTHING_MM 1e-12f /* what is smaller counts as 0, so that no product of two is lost by float32 */

/* Corners as the camera sees them: mm to the right, up, and the depth. */
typedef struct {
    float x[3], y[3], depth[3];
} corners;

/* A place on a triangle: its depth, and the shares of the corners, of any common length. */
typedef struct {
    float depth, total, share[3];
} meeting;

static inline corners load_corners(
    __global const float *placed, __global const uint *triangles, const size_t triangle)
{
    corners c;
    for (int corner = 0; corner < 3; ++corner) {
        const size_t vertex = triangles[3 * triangle + corner];
        c.x[corner] = placed[3 * vertex];
        c.y[corner] = placed[3 * vertex + 1];
        c.depth[corner] = placed[3 * vertex + 2];
    }
    return c;
}

/* What rounding took from a product (Dekker 1971, with halves after Veltkamp 1968). */
static inline float product_error(const float a, const float b, const float product)
{
    const float wide_a = 4097.0f * a, wide_b = 4097.0f * b;
    const float high_a = wide_a - (wide_a - a), high_b = wide_b - (wide_b - b);
    const float low_a = a - high_a, low_b = b - high_b;
    return (((high_a * high_b - product) + high_a * low_b) + low_a * high_b) + low_a * low_b;
}

/* Side of the edge a -> b on which the ray passes, 1 or -1, or 0 where a and b are one place; *area: ax by - ay bx. */
static inline int find_side(const float ax, const float ay, const float bx, const float by, float *area)
{
    const float one = ax * by, other = ay * bx;
    if (one != other) {
        *area = one - other;
        return one > other ? 1 : -1;
    }
    const float one_rest = product_error(ax, by, one), other_rest = product_error(ay, bx, other);
    *area = one_rest - other_rest;
    if (one_rest != other_rest)
        return one_rest > other_rest ? 1 : -1;
    if (ay != by)
        return ay > by ? 1 : -1;
    return bx > ax ? 1 : bx < ax ? -1 : 0;
}

static inline float drop_nothing(const float length) { return fabs(length) < NOTHING_MM ? 0.0f : length; }

/* Whether the ray of a pixel meets a triangle, and where. */
static inline int meet_triangle(const corners *c, const float4 pixel, const int column, const int row, meeting *m)
{
    const float aside = (((float)column + 0.5f) - pixel.y) * pixel.x, upwards = (pixel.z - ((float)row + 0.5f)) * pixel.x;
    float x[3], y[3];
    for (int corner = 0; corner < 3; ++corner) {
        const float scale = pixel.w > 0.0f ? c->depth[corner] : 1.0f;
        x[corner] = drop_nothing(c->x[corner] - scale * aside);
        y[corner] = drop_nothing(c->y[corner] - scale * upwards);
    }
    const int side = find_side(x[0], y[0], x[1], y[1], m->share + 2);
    if (side == 0 || find_side(x[1], y[1], x[2], y[2], m->share) != side
        || find_side(x[2], y[2], x[0], y[0], m->share + 1) != side)
        return 0;
    m->total = (m->share[0] + m->share[1]) + m->share[2];
    const float sum = (m->share[0] * c->depth[0] + m->share[1] * c->depth[1]) + m->share[2] * c->depth[2];
    const float least = min(min(c->depth[0], c->depth[1]), c->depth[2]);
    const float most = max(max(c->depth[0], c->depth[1]), c->depth[2]);
    m->depth = clamp(sum / m->total, least, most);
    return pixel.w <= 0.0f || m->depth >= NEAREST_MM;
}

/* Whether a place at a depth in a pixel is kept by all clip planes: a x + b y + c depth >= d, in mm of the camera. */
static inline int is_kept(__global const float4 *planes, const uint plane_count, const float4 pixel, const int column,
    const int row, const float depth)
{
    const float scale = pixel.w > 0.0f ? depth : 1.0f;
    const float x = scale * ((((float)column + 0.5f) - pixel.y) * pixel.x);
    const float y = scale * ((pixel.z - ((float)row + 0.5f)) * pixel.x);
    for (uint plane = 0; plane < plane_count; ++plane) {
        const float4 side = planes[plane];
        if ((side.x * x + side.y * y) + side.z * depth < side.w)
            return 0;
    }
    return 1;
}

#endif
