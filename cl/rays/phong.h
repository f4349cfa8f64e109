/* Light on surfaces (Phong 1975, with Blinn's halfway vector).  Normals are turned towards the viewer, so that a light
 * at the camera lights both sides of a surface; a fixed light only lights surfaces that face it, as in VTK. */
#ifndef CLRECON_PHONG_H
#define CLRECON_PHONG_H

#include "rays/field.h"
#include "rays/shade.h"
#include "rays/stack.h"
#include "rays/view.h"

/* Highlight of LANES cosines of 0 to 1, and their squares: specular * cosine ^ power. */
static inline floats find_highlight(
    const float4 phong, __global const float *highlights, const floats cosine, const floats cosine_squared)
{
    const int power = (int)phong.w;
    if ((float)power == phong.w) { /* squares are faster than a table */
        floats result = power & 1 ? phong.z * cosine : (floats)(phong.z), square = cosine_squared;
        for (int bits = power >> 1; bits > 0; bits >>= 1) {
            result = bits & 1 ? result * square : result;
            square = square * square;
        }
        return result;
    }
    const floats entry = cosine * (HIGHLIGHTS - 1);
    const ints at = lesser_int(to_ints(entry), (ints)(HIGHLIGHTS - 2));
    const floats low = (floats)(GATHER(float, highlights, at)), high = (floats)(GATHER(float, highlights + 1, at));
    return low + (entry - to_floats(at)) * (high - low);
}

/* LPS gradients per mm of LANES places with index coordinate k. */
static inline void find_gradients(__global const float4 *view, const slice_stack *stack, const slopes *s,
    const floats k, floats *x, floats *y, floats *z)
{
#ifdef UNEVEN
    float part[7][LANES], lane_k[LANES], gradient[3][LANES];
    store_lanes(s->below_i, part[0]);
    store_lanes(s->below_j, part[1]);
    store_lanes(s->below_k, part[2]);
    store_lanes(s->above_i, part[3]);
    store_lanes(s->above_j, part[4]);
    store_lanes(s->above_k, part[5]);
    store_lanes(s->share, part[6]);
    store_lanes(k, lane_k);
    for (int lane = 0; lane < LANES; ++lane) {
        /* Each slice has a matrix of its own. */
        const int layer = clamp((int)lane_k[lane], 0, stack->nk - 2);
        const float4 below = (float4)(part[0][lane], part[1][lane], part[2][lane], 0.0f);
        const float4 above = (float4)(part[3][lane], part[4][lane], part[5][lane], 0.0f);
        __global const float4 *low = stack->slices + 4 * layer + 1, *high = low + 4;
        for (int axis = 0; axis < 3; ++axis) {
            const float from = dot4(low[axis], below), to = dot4(high[axis], above);
            gradient[axis][lane] = from + part[6][lane] * (to - from);
        }
    }
    *x = load_lanes(gradient[0]);
    *y = load_lanes(gradient[1]);
    *z = load_lanes(gradient[2]);
#else
    floats i, j, k_step;
    mix_slopes(s, &i, &j, &k_step);
    const float4 row_x = view[VIEW_NORMAL_X], row_y = view[VIEW_NORMAL_Y], row_z = view[VIEW_NORMAL_Z];
    *x = row_x.x * i + row_x.y * j + row_x.z * k_step;
    *y = row_y.x * i + row_y.y * j + row_y.z * k_step;
    *z = row_z.x * i + row_z.y * j + row_z.z * k_step;
#endif
}

/* Light on LANES places with LPS gradients (x, y, z), seen along unit vectors: a place takes `share` of its own colour
 * and `highlight` of white.  The direction of a smaller gradient counts less. */
static inline void find_light(__global const float4 *view, __global const float *highlights,
    const floats x, const floats y, const floats z, const floats direction_x, const floats direction_y,
    const floats direction_z, floats *share, floats *highlight)
{
    const float4 phong = view[VIEW_PHONG], fixed_light = view[VIEW_LIGHT];
    const floats size = x * x + y * y + z * z, divisor = greater(size, (floats)(1e-12f));
    floats cosine_squared, middle_squared;
    if (fixed_light.w > 0.0f) {
        const floats along = x * fixed_light.x + y * fixed_light.y + z * fixed_light.z;
        const floats ahead = x * direction_x + y * direction_y + z * direction_z;
        const ints lit = along * ahead < 0.0f; /* light and viewer on the same side */
        cosine_squared = choose(lit, along * along / divisor, (floats)(0.0f));
        const floats half_x = fixed_light.x - direction_x, half_y = fixed_light.y - direction_y;
        const floats half_z = fixed_light.z - direction_z;
        const floats length_squared = greater(half_x * half_x + half_y * half_y + half_z * half_z, (floats)(1e-12f));
        const floats half_way = x * half_x + y * half_y + z * half_z;
        const floats squared = lesser(half_way * half_way / (divisor * length_squared), (floats)(1.0f));
        middle_squared = choose(lit, squared, (floats)(0.0f));
    } else {
        const floats along = x * direction_x + y * direction_y + z * direction_z;
        cosine_squared = along * along / divisor;
        middle_squared = lesser(cosine_squared, (floats)(1.0f));
    }
    const floats cosine = sqrt(cosine_squared);
    const floats certain = size / (size + view[VIEW_NEAR].z);
    *share = phong.x + phong.y * (1.0f + certain * (cosine - 1.0f));
    *highlight = certain * find_highlight(phong, highlights, sqrt(middle_squared), middle_squared);
}

#endif
