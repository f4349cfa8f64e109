/* Rays of LANES pixels at once, see start_ray() in rays/view.h.
 *
 *      tiles, and with 2 queues      a tile: 8 x 8 pixels      a packet with LANES = 8: a row of the tile,
 *      in the order of items         0  1  2 ...  7            pixels x to x + 7 of one row of the picture:
 *      0  3  1                       8  9 10 ... 15            lanes 0, 1, 2 ... 7 of each `floats`;
 *      4  2  5                       ...                       with LANES = 1 one pixel */
#ifndef CLRECON_RAY_PACKET_H
#define CLRECON_RAY_PACKET_H

#include "include/lanes.h"
#include "rays/leap.h"
#include "rays/view.h"

/* Field coordinates at distance t mm from a ray's origin are origin + t * step; it crosses the box, and what the clip
 * planes leave of it, from t_in to t_out, and the focus from focus_in to focus_out. */
typedef struct {
    floats origin_i, origin_j, origin_k, step_i, step_j, step_k;
    floats toward_x, toward_y, toward_z; /* unit direction, LPS */
    floats offset; /* mm from the camera to the origin */
    floats t_in, t_out, focus_in, focus_out;
} ray_packet;

static inline void clip_to_slab(const floats origin, const floats step, const float low, const float high,
    floats *t_in, floats *t_out)
{
    /* A ray along a face neither divides by zero nor gets lost. */
    const floats rate = choose(fabs(step) < 1e-12f, (floats)(1e-12f), step);
    const floats to_low = (low - origin) / rate, to_high = (high - origin) / rate;
    *t_in = greater(*t_in, lesser(to_low, to_high));
    *t_out = lesser(*t_out, greater(to_low, to_high));
}

static inline void clip_packet_to_box(
    const ray_packet *r, const float4 low, const float4 high, floats *t_in, floats *t_out)
{
    clip_to_slab(r->origin_i, r->step_i, low.x, high.x, t_in, t_out);
    clip_to_slab(r->origin_j, r->step_j, low.y, high.y, t_in, t_out);
    clip_to_slab(r->origin_k, r->step_k, low.z, high.z, t_in, t_out);
}

/* Set up the rays of pixels (x, y). */
static inline void start_packet(__global const float4 *view, const floats x, const floats y, const uint planes,
    const int perspective, ray_packet *r)
{
    const float4 direction = view[VIEW_DIRECTION], direction_x = view[VIEW_DIRECTION_X];
    const float4 direction_y = view[VIEW_DIRECTION_Y];
    r->toward_x = direction.x + x * direction_x.x + y * direction_y.x;
    r->toward_y = direction.y + x * direction_x.y + y * direction_y.y;
    r->toward_z = direction.z + x * direction_x.z + y * direction_y.z;
    const floats length_mm = sqrt(r->toward_x * r->toward_x + r->toward_y * r->toward_y + r->toward_z * r->toward_z);
    r->toward_x /= length_mm;
    r->toward_y /= length_mm;
    r->toward_z /= length_mm;
    const float4 origin = view[VIEW_ORIGIN], origin_x = view[VIEW_ORIGIN_X], origin_y = view[VIEW_ORIGIN_Y];
    r->origin_i = origin.x + x * origin_x.x + y * origin_y.x;
    r->origin_j = origin.y + x * origin_x.y + y * origin_y.y;
    r->origin_k = origin.z + x * origin_x.z + y * origin_y.z;
    const float4 step = view[VIEW_STEP], step_x = view[VIEW_STEP_X], step_y = view[VIEW_STEP_Y];
    r->step_i = (step.x + x * step_x.x + y * step_y.x) / length_mm;
    r->step_j = (step.y + x * step_x.y + y * step_y.y) / length_mm;
    r->step_k = (step.z + x * step_x.z + y * step_y.z) / length_mm;
    r->offset = view[VIEW_NEAR].x * length_mm;
    r->t_in = perspective ? -r->offset : (floats)(-MAXFLOAT);
    r->t_out = MAXFLOAT;
    clip_packet_to_box(r, view[VIEW_BOX_LOW], view[VIEW_BOX_HIGH], &r->t_in, &r->t_out);
    for (uint plane = 0; plane < planes; ++plane) {
        const float4 side = view[VIEW_PLANES + plane];
        const floats at = side.x * r->origin_i + side.y * r->origin_j + side.z * r->origin_k - side.w;
        const floats rate = side.x * r->step_i + side.y * r->step_j + side.z * r->step_k;
        const ints along = fabs(rate) < 1e-12f;
        const floats crossing = -at / choose(along, (floats)(1e-12f), rate);
        const floats t_in = choose(rate > 0.0f, greater(r->t_in, crossing), r->t_in);
        const floats t_out = choose(rate > 0.0f, r->t_out, lesser(r->t_out, crossing));
        r->t_out = choose(along, choose(at < 0.0f, r->t_in, r->t_out), t_out);
        r->t_in = choose(along, r->t_in, t_in);
    }
    r->focus_in = r->t_in;
    r->focus_out = r->t_out;
    clip_packet_to_box(r, view[VIEW_FOCUS_LOW], view[VIEW_FOCUS_HIGH], &r->focus_in, &r->focus_out);
}

/* The course of samples every `step` mm from t on. */
static inline void lay_course(
    const ray_packet *r, const floats t, const floats step, const float4 slope, ray_lanes *course)
{
    course->start_i = r->origin_i + t * r->step_i;
    course->start_j = r->origin_j + t * r->step_j;
    course->start_k = r->origin_k + t * r->step_k;
    course->stride_i = step * r->step_i;
    course->stride_j = step * r->step_j;
    course->stride_k = step * r->step_k;
    find_pace(course, slope);
}

#endif
