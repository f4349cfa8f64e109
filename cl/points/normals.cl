/* Normals of points: the smallest principal axis of each point's neighbours, and its direction.
 *
 * The covariance of the neighbours has the eigenvalues l0 <= l1 <= l2.  Its trace is divided out, so that l0 is the
 * smallest root of l^3 - l^2 + b l - c.  Laguerre's iteration begins at 0, below all roots; as all are real it comes
 * near l0 from below, without acos and cos, and 6 steps reach float32's precision.  The axis is the longest of the cross
 * products of rows of the covariance less l0.
 *
 * Reference: H. Hoppe, T. DeRose, T. Duchamp, J. McDonald, W. Stuetzle, "Surface reconstruction from unorganized
 * points", 1992; the iteration: F. S. Acton, "Numerical methods that work", 1990, chapter 7.
 *
 * Passes
 *   1. fit_planes       for each part of the points, after list_neighbours
 *   2. orient_normals   for the same part */

#include "points/near_rows.h"

#define LAGUERRE_STEPS 6

/* Squares of a cross product's length, with a trace of 1, up to which there is no plane: rounding gives 1e-14. */
#define NO_PLANE 1e-10f

/* Sum of the products of two eigenvalues, with a trace of 1, up to which points lie in a line: there the smallest root
 * is a double one, found to the root of float32's precision only.  Rounding gives up to 8e-7 (128 points). */
#define NO_WIDTH 4e-6f

#define DOUBTFUL_COSINE 0.2f

#define ORIENT_NOT 0
#define ORIENT_DOWN 1
#define ORIENT_AWAY 2

#define STATE_SURE 0
#define STATE_DOUBTFUL 1
#define STATE_UNORIENTED 2
#define STATE_NO_PLANE 3

/* Smallest root of l^3 - l^2 + b l - c, whose roots are real and not negative. */
static inline floats smallest_root(const floats b, const floats c)
{
    floats l = 0.0f;
    for (int step = 0; step < LAGUERRE_STEPS; ++step) {
        const floats value = ((l - 1.0f) * l + b) * l - c, slope = (3.0f * l - 2.0f) * l + b, bend = 6.0f * l - 2.0f;
        const floats under = greater(4.0f * slope * slope - 6.0f * value * bend, (floats)(0.0f));
        const floats below = slope + sqrt(under);
        const floats move = choose(below > 1e-12f, 3.0f * value / below, (floats)(0.0f));
        l = greater(l - move, l);
    }
    return l;
}

/* Parameters  x y z      in   (points) mm, sorted by cell
 *             neighbours in   (place_count, k) places of the neighbours
 *             normals    out  (3, place_count) unit vectors of either direction; zero where there is no plane
 *             variations out  (place_count) l0 / (l0 + l1 + l2); 0 where there is no plane
 *             first_place, place_count, k
 * Launch      global = ceil(place_count / LANES), rounded up by the host, any local
 * Assumes     k at least 1
 * Guarantees  every normal and variation of the part is written; no pair of rows, no line of points has a normal */
__kernel void fit_planes(
    __global const float *restrict x, __global const float *restrict y, __global const float *restrict z,
    __global const int *restrict neighbours, __global float *restrict normals, __global float *restrict variations,
    const uint first_place, const uint place_count, const int k)
{
    const uint row = get_global_id(0) * LANES;
    if (row >= place_count)
        return;
    near_rows rows;
    take_rows(&rows, x, y, z, first_place, place_count, row, k);
    floats sx = 0.0f, sy = 0.0f, sz = 0.0f, xx = 0.0f, xy = 0.0f, xz = 0.0f, yy = 0.0f, yz = 0.0f, zz = 0.0f;
    for (int t = 0; t < k; ++t) {
        floats dx, dy, dz;
        neighbour_of_rows(x, y, z, neighbours, rows, t, &dx, &dy, &dz);
        sx += dx;
        sy += dy;
        sz += dz;
        xx += dx * dx;
        xy += dx * dy;
        xz += dx * dz;
        yy += dy * dy;
        yz += dy * dz;
        zz += dz * dz;
    }
    const float share = 1.0f / (float)k;
    xx -= sx * sx * share;
    xy -= sx * sy * share;
    xz -= sx * sz * share;
    yy -= sy * sy * share;
    yz -= sy * sz * share;
    zz -= sz * sz * share;
    const floats trace = xx + yy + zz;
    const floats scale = choose(trace > 1e-30f, 1.0f / trace, (floats)(0.0f));
    xx *= scale;
    xy *= scale;
    xz *= scale;
    yy *= scale;
    yz *= scale;
    zz *= scale;
    const floats b = xx * yy - xy * xy + (xx * zz - xz * xz) + (yy * zz - yz * yz);
    const floats c = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz);
    const floats l = smallest_root(b, c);
    const floats a0 = xx - l, a1 = yy - l, a2 = zz - l;
    floats nx = xy * yz - xz * a1, ny = xz * xy - a0 * yz, nz = a0 * a1 - xy * xy;
    floats longest = nx * nx + ny * ny + nz * nz;
    const floats ux = xy * a2 - xz * yz, uy = xz * xz - a0 * a2, uz = a0 * yz - xy * xz;
    const floats second = ux * ux + uy * uy + uz * uz;
    nx = choose(second > longest, ux, nx);
    ny = choose(second > longest, uy, ny);
    nz = choose(second > longest, uz, nz);
    longest = greater(second, longest);
    const floats vx = a1 * a2 - yz * yz, vy = yz * xz - xy * a2, vz = xy * yz - a1 * xz;
    const floats third = vx * vx + vy * vy + vz * vz;
    nx = choose(third > longest, vx, nx);
    ny = choose(third > longest, vy, ny);
    nz = choose(third > longest, vz, nz);
    longest = choose(b > NO_WIDTH, greater(third, longest), (floats)(0.0f));
    const floats size = choose(longest > NO_PLANE, 1.0f / sqrt(longest), (floats)(0.0f));
    store_rows(nx * size, normals, row, place_count);
    store_rows(ny * size, normals + place_count, row, place_count);
    store_rows(nz * size, normals + 2 * (size_t)place_count, row, place_count);
    store_rows(choose(longest > NO_PLANE, l, (floats)(0.0f)), variations, row, place_count);
}

/* Parameters  x y z      in   (points) mm, sorted by cell
 *             order      in   (points) number of each point in the cloud
 *             normals    in   (3, place_count) of fit_planes
 *             gradients  in   ORIENT_DOWN: (points, 3) HU per mm by the points' numbers; else not read
 *             oriented   out  (points, 3) by the points' numbers
 *             states     out  (points) STATE_ of each point, by number
 *             viewpoint  ORIENT_AWAY: mm
 *             how        ORIENT_DOWN: towards lower HU, and the gradient itself where the cosine of both is below
 *                        DOUBTFUL_COSINE; ORIENT_AWAY: from the viewpoint; ORIENT_NOT
 *             first_place, place_count
 * Launch      global = place_count rounded up by the host, any local
 * Assumes     nothing
 * Guarantees  every point of the part is written; normals are unit vectors, or zero with STATE_NO_PLANE */
__kernel void orient_normals(
    __global const float *restrict x, __global const float *restrict y, __global const float *restrict z,
    __global const uint *restrict order, __global const float *restrict normals,
    __global const float *restrict gradients, __global float *restrict oriented, __global uchar *restrict states,
    const float4 viewpoint, const int how, const uint first_place, const uint place_count)
{
    const size_t row = get_global_id(0);
    if (row >= place_count)
        return;
    const size_t place = first_place + row, number = order[place];
    float3 normal = (float3)(normals[row], normals[place_count + row], normals[2 * (size_t)place_count + row]);
    const int has_plane = dot3(normal, normal) > 0.0f;
    uchar state = has_plane ? STATE_UNORIENTED : STATE_NO_PLANE;
    if (how == ORIENT_DOWN) {
        const float3 down = -vload3(number, gradients);
        const float steepness = sqrt(dot3(down, down));
        if (steepness > 0.0f && isfinite(steepness)) {
            const float cosine = dot3(normal, down) / steepness;
            const int doubtful = fabs(cosine) < DOUBTFUL_COSINE;
            normal = doubtful ? down / steepness : cosine < 0.0f ? -normal : normal;
            state = has_plane ? (doubtful ? STATE_DOUBTFUL : STATE_SURE) : STATE_DOUBTFUL;
        }
    } else if (how == ORIENT_AWAY && has_plane) {
        const float cosine = dot3(normal, (float3)(x[place], y[place], z[place]) - viewpoint.xyz);
        normal = cosine < 0.0f ? -normal : normal;
        state = STATE_SURE;
    }
    vstore3(normal, number, oriented);
    states[number] = state;
}
