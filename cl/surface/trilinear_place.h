/* Places of the vertices inside a cell, in steps from its corner 0, and the gradient of the trilinear field there. */
#ifndef CLRECON_TRILINEAR_PLACE_H
#define CLRECON_TRILINEAR_PLACE_H

#include "surface/trilinear_cell.h"
#include "surface/vertex_group.h"

#define CELL_VERTEX 12
#define NEWTON_STEPS 3
/* Squared gradient, per step and in the units of the whole numbers, below which no step of Newton is taken. */
#define FLAT_SQUARE 16777216.0f

/* The field between the corners and its gradient per step. */
static inline float field_at(const int8 values, float3 p, float3 *gradient)
{
    const float4 rise = convert_float4(values.odd - values.even);
    const float4 along = convert_float4(values.even) + p.x * rise;
    const float low = along.x + p.y * (along.y - along.x), high = along.z + p.y * (along.w - along.z);
    const float low_x = rise.x + p.y * (rise.y - rise.x), high_x = rise.z + p.y * (rise.w - rise.z);
    const float low_y = along.y - along.x, high_y = along.w - along.z;
    *gradient = (float3)(low_x + p.z * (high_x - low_x), low_y + p.z * (high_y - low_y), high - low);
    return low + p.z * (high - low);
}

/* The vertex in the middle of a fan: the mean of those around it, taken to the surface by some steps of Newton. */
static inline float3 place_centre(uint row, const int8 values, float3 margin)
{
    float3 point = (float3)(0.0f);
    float around = 0.0f;
    for (uint n = 0; n < row_triangles_of(row); ++n) {
        const uint triangle = TRILINEAR_TRIANGLES[(row & 0xffff) + n];
        if ((triangle & 31) != CELL_VERTEX)
            continue;
        const uint edge = triangle >> 5 & 31, axis = edge >> 2;
        /* Lower corner of an edge: its number among those of its axis, spread over the two other bits. */
        const uint place = edge & 3;
        const uint low = axis == 0 ? place << 1 : axis == 1 ? (place & 1) | (place & 2) << 1 : place;
        const int height = pick_8(values, low), rise = pick_8(values, low | 1u << axis) - height;
        const float keep = axis == 0 ? margin.x : axis == 1 ? margin.y : margin.z;
        const float t = rise == 0 ? 0.5f : clamp(convert_float(-height) / convert_float(rise), keep, 1.0f - keep);
        point += (float3)(axis == 0 ? t : (float)(low & 1), axis == 1 ? t : (float)(low >> 1 & 1),
            axis == 2 ? t : (float)(low >> 2));
        around += 1.0f;
    }
    point /= around;
    for (int n = 0; n < NEWTON_STEPS; ++n) {
        float3 gradient;
        const float value = field_at(values, point, &gradient);
        const float square = dot3(gradient, gradient);
        if (square >= FLAT_SQUARE)
            point = clamp(point - gradient * (value / square), margin, 1.0f - margin);
    }
    return point;
}

/* The box whose corners are the waist of a tunnel: the roots of the three parabolas.  It keeps a margin from the faces
 * and is at least two margins wide. */
static inline void place_waist(const int8 values, float3 margin, float3 *lower, float3 *upper)
{
    *lower = *upper = (float3)(0.0f);
    for (uint axis = 0; axis < 3; ++axis) {
        parabola q;
        find_parabola(&q, values, axis);
        const float keep = axis == 0 ? margin.x : axis == 1 ? margin.y : margin.z;
        const float twice = 2.0f * convert_float(q.a);
        const float discriminant = q.discriminant_high < 0
            ? 0.0f
            : convert_float(q.discriminant_high) * 18446744073709551616.0f + convert_float(q.discriminant_low);
        float half_width = q.a != 0 ? sqrt(discriminant) / fabs(twice) : 0.0f;
        float middle = q.a != 0 ? convert_float(-q.b) / twice : 0.5f;
        half_width = clamp(half_width, keep, 0.5f - keep);
        middle = clamp(middle, keep + half_width, 1.0f - keep - half_width);
        const int3 here = (int3)(0, 1, 2) == (int)axis;
        *lower = here ? (float3)(middle - half_width) : *lower;
        *upper = here ? (float3)(middle + half_width) : *upper;
    }
}

/* One coordinate in mm of a point of the cell at sample (i, j): an exact sum of the origin and the steps, plus the
 * small terms, as in place_vertices. */
static inline float place_cell_vertex(
    float i, float j, float3 point,
    float origin, float origin_rest, float i_step, float i_rest, float j_step, float j_rest, float k_step)
{
    float rest = origin_rest + (i * i_rest + j * j_rest);
    float place = add_exactly(origin, j * j_step, &rest);
    place = add_exactly(place, i * i_step, &rest);
    return place
        + (rest + (point.x * (i_step + i_rest) + point.y * (j_step + j_rest) + point.z * k_step));
}

#endif
