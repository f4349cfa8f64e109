/* The trilinear field of a volume: values for LANES places at once, gradients for one.
 *
 * Half a voxel around the outermost voxel centres belongs to the volume and has the nearest centre's value. */
#ifndef CLRECON_FIELD_H
#define CLRECON_FIELD_H

#include "include/lanes.h"
#include "include/volume.h"

/* A volume, or the slices of it from first_k to end_k - 1 that a device holds: at least two along each axis. */
typedef struct {
    __global const VOXEL *voxels;
    int ni, nj; /* of the buffer */
    int first_k, end_k;
    float4 last; /* indices of the last voxel centres of the whole volume, along i, j, k */
} field;

#ifndef VOXEL_IS_SHORT
#define VOXEL_IS_SHORT 0 /* VOXEL is short: two of them are one int */
#endif

#define VOXEL2 CLRECON_VECTOR(VOXEL, 2)
#define VOXEL4 CLRECON_VECTOR(VOXEL, 4)

/* Values at offset `at` from `corner` and one further along i.  Two 16-bit voxels come with one load. */
#if LANES == 8 && VOXEL_IS_SHORT
#define PAIR(corner, at) as_int(vload2(0, (corner) + (at)))
#define LOAD_PAIRS(corner, at, low, high) \
    { \
        const ints pairs = (ints)(PAIR(corner, (at).s0), PAIR(corner, (at).s1), PAIR(corner, (at).s2), \
            PAIR(corner, (at).s3), PAIR(corner, (at).s4), PAIR(corner, (at).s5), PAIR(corner, (at).s6), \
            PAIR(corner, (at).s7)); \
        low = to_floats((pairs << 16) >> 16); \
        high = to_floats(pairs >> 16); \
    }
#else
#define LOAD_PAIRS(corner, at, low, high) \
    { \
        low = (floats)(GATHER(corner, at)); \
        high = (floats)(GATHER(corner + 1, at)); \
    }
#endif

/* Values at LANES places near each other, index coordinates. */
static inline floats sample_lanes(const field *f, const floats i, const floats j, const floats k)
{
    const floats at_i = min(max(i, (floats)(0.0f)), (floats)(f->last.x));
    const floats at_j = min(max(j, (floats)(0.0f)), (floats)(f->last.y));
    const floats at_k = min(max(k, (floats)(0.0f)), (floats)(f->last.z));
    const ints cell_i = min(to_ints(at_i), (ints)(f->ni - 2));
    const ints cell_j = min(to_ints(at_j), (ints)(f->nj - 2));
    const ints cell_k = clamp(to_ints(at_k), (ints)(f->first_k), (ints)(f->end_k - 2));
    const floats part_i = at_i - to_floats(cell_i), part_j = at_j - to_floats(cell_j);
    const floats part_k = at_k - to_floats(cell_k);
    /* Lanes lie near each other, so what they differ by is a small number. */
    const int base_i = FIRST_LANE(cell_i), base_j = FIRST_LANE(cell_j), base_k = FIRST_LANE(cell_k);
    __global const VOXEL *corner = f->voxels + voxel_index(base_i, base_j, base_k - f->first_k, f->ni, f->nj);
    const ints at = ((cell_k - base_k) * f->nj + (cell_j - base_j)) * f->ni + (cell_i - base_i);
    const int row = f->ni, slice = f->ni * f->nj;
    floats low, high;
    LOAD_PAIRS(corner, at, low, high)
    const floats front_near = low + part_i * (high - low);
    LOAD_PAIRS(corner + row, at, low, high)
    const floats front_far = low + part_i * (high - low);
    LOAD_PAIRS(corner + slice, at, low, high)
    const floats back_near = low + part_i * (high - low);
    LOAD_PAIRS(corner + slice + row, at, low, high)
    const floats back_far = low + part_i * (high - low);
    const floats front = front_near + part_j * (front_far - front_near);
    const floats back = back_near + part_j * (back_far - back_near);
    return front + part_k * (back - front);
}

/* Differences per index step, interpolated within the slices below and above a place: central differences of voxels,
 * half a one-sided difference at the border.  Returns the share of the slice above. */
static inline float find_differences(const field *f, const float3 place, float4 *below, float4 *above)
{
    const float at_i = clamp(place.x, 0.0f, f->last.x), at_j = clamp(place.y, 0.0f, f->last.y);
    const float at_k = clamp(place.z, 0.0f, f->last.z);
    const int i = min((int)at_i, f->ni - 2), j = min((int)at_j, f->nj - 2);
    const int k = clamp((int)at_k, f->first_k, f->end_k - 2);
    const float part_i = at_i - (float)i, part_j = at_j - (float)j;
    const int row = f->ni, slice = f->ni * f->nj;
    __global const VOXEL *corner = f->voxels + voxel_index(i, j, k - f->first_k, f->ni, f->nj);
    /* Rows through the cell with a voxel more at either side, the rows beside them, and the slices under and over. */
    const int down = j > 0 ? -row : 0, up = j + 2 < f->nj ? 2 * row : row;
    const int under = k > f->first_k ? -slice : 0, over = k + 2 < f->end_k ? 2 * slice : slice;
    float4 middle[4];
    float2 side[4], beyond[4];
#define ROW2(at) CLRECON_JOIN(convert_float, 2)(vload2(0, corner + (at)))
    if (i > 0 && i + 2 < f->ni) {
#define ROW4(at) CLRECON_JOIN(convert_float, 4)(vload4(0, corner + (at) - 1))
        middle[0] = ROW4(0);
        middle[1] = ROW4(row);
        middle[2] = ROW4(slice);
        middle[3] = ROW4(slice + row);
#undef ROW4
    } else {
        const int left = i > 0 ? -1 : 0, right = i + 2 < f->ni ? 2 : 1;
#define ROW4(at) (float4)((float)corner[(at) + left], ROW2(at), (float)corner[(at) + right])
        middle[0] = ROW4(0);
        middle[1] = ROW4(row);
        middle[2] = ROW4(slice);
        middle[3] = ROW4(slice + row);
#undef ROW4
    }
    side[0] = ROW2(down);
    side[1] = ROW2(up);
    side[2] = ROW2(slice + down);
    side[3] = ROW2(slice + up);
    beyond[0] = ROW2(under);
    beyond[1] = ROW2(under + row);
    beyond[2] = ROW2(over);
    beyond[3] = ROW2(over + row);
#undef ROW2
    const float2 near_i = (float2)(1.0f - part_i, part_i);
    const float near_j = 1.0f - part_j, far_j = part_j;
    const float4 low = near_j * middle[0] + far_j * middle[1], high = near_j * middle[2] + far_j * middle[3];
    const float2 low_i = low.zw - low.xy, high_i = high.zw - high.xy;
    const float2 low_j = near_j * (middle[1].yz - side[0]) + far_j * (side[1] - middle[0].yz);
    const float2 high_j = near_j * (middle[3].yz - side[2]) + far_j * (side[3] - middle[2].yz);
    const float2 low_k = high.yz - (near_j * beyond[0] + far_j * beyond[1]);
    const float2 high_k = near_j * beyond[2] + far_j * beyond[3] - low.yz;
    *below = 0.5f * (float4)(dot(low_i, near_i), dot(low_j, near_i), dot(low_k, near_i), 0.0f);
    *above = 0.5f * (float4)(dot(high_i, near_i), dot(high_j, near_i), dot(high_k, near_i), 0.0f);
    return at_k - (float)k;
}

#endif
