/* Gradient and light at a single place, for rays that stop at a hit. */
#ifndef CLRECON_HIT_H
#define CLRECON_HIT_H

#include "rays/field.h"
#include "rays/phong.h"
#include "rays/shade.h"

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
    *below = 0.5f * (float4)(dot2(low_i, near_i), dot2(low_j, near_i), dot2(low_k, near_i), 0.0f);
    *above = 0.5f * (float4)(dot2(high_i, near_i), dot2(high_j, near_i), dot2(high_k, near_i), 0.0f);
    return at_k - (float)k;
}

/* `color` of a surface with LPS gradient `gradient`, seen along unit vector `direction`, see rays/shade.h. */
static inline float3 shade(__global const float4 *view, __global const float *highlights,
    const float3 color, const float3 gradient, const float3 direction)
{
    return shade_place(view[VIEW_PHONG], view[VIEW_LIGHT], highlights, color, gradient, direction);
}

#endif
