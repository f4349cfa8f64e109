/* Labels on the closed surface: the label of a place, and the way of rays and light through translucent labels. */
#ifndef CLRECON_SURFACE_LABELS_H
#define CLRECON_SURFACE_LABELS_H

#include "include/label_owner.h"
#include "rays/label_color.h"
#include "rays/surface_lines.h"

#define DARK 0.01f /* no light is left */

/* Label of a place on the surface: that which owns the nearest voxel of its cell that is inside, as in meshes. */
static inline uint find_surface_label(
    const scene *s, __global const LABEL *labels, __global const int4 *near, const int offsets,
    const float4 field_place)
{
    const closed_field *f = &s->field;
    const field *inner = &f->inner;
    const float3 place = index_of(s, field_place);
    const float3 base = floor(place);
    float nearest = MAXFLOAT;
    int i = 0, j = 0, k = 0;
    for (int corner = 0; corner < 8; ++corner) {
        const float3 at = base + (float3)((float)(corner & 1), (float)(corner >> 1 & 1), (float)(corner >> 2));
        const float3 away = at - place;
        const float distance = dot3(away, away);
        if (distance >= nearest || read_closed(f, (int)at.x, (int)at.y, (int)at.z) < f->level)
            continue;
        nearest = distance;
        i = (int)at.x;
        j = (int)at.y;
        k = clamp((int)at.z, inner->first_k, inner->end_k - 1) - inner->first_k;
    }
    const int slices = inner->end_k - inner->first_k;
    return nearest == MAXFLOAT ? 0 : find_owner(labels, near, offsets, i, j, k, inner->ni, inner->nj, slices);
}

/* The first sample of n to end - 1 that is outside, or inside of another label than `passed`; end where there is none.
 * `label` becomes that other label, 0 where it is outside. */
static inline int leave_label(
    const scene *s, __global const LABEL *labels, const line *along, int n, const int end,
    const uint passed, uint *label)
{
    int going = 1;
    *label = 0;
    while (going && n < end) {
        const int outside = FIRST_LANE(sample_line(s, along, (floats)((float)n))) < s->field.level;
        const uint here = outside ? 0 : find_label(labels, &s->field.inner, index_of(s, place_on(along, (float)n)));
        going = !outside && (here == 0 || here == passed);
        *label = going ? 0 : here;
        n += going;
    }
    return n;
}

/* Differences per index step of being in a label, over the 27 voxels around a place. */
static inline float4 find_label_differences(
    __global const LABEL *labels, const field *f, const float3 place, const uint label)
{
    float4 sum = (float4)(0.0f);
    for (int c = -1; c <= 1; ++c)
        for (int b = -1; b <= 1; ++b)
            for (int a = -1; a <= 1; ++a) {
                const float4 way = (float4)((float)a, (float)b, (float)c, 0.0f);
                sum += find_label(labels, f, place + way.xyz) == label ? way : (float4)(0.0f);
            }
    return sum / 18.0f;
}

/* Share of the light that passes the part of a line that is inside, beginning at sample n, which is. */
static inline float let_light_through(
    const scene *s, __global const LABEL *labels, __global const int4 *near, const int offsets,
    __global const float4 *label_colors, const line *to_light, int n, const int end)
{
    float light = 1.0f;
    uint label = find_surface_label(s, labels, near, offsets, place_on(to_light, (float)n));
    int inside = 1;
    while (n < end && light > DARK) {
        if (inside) {
            const uint passed = label;
            light *= 1.0f - label_colors[passed].w;
            n = leave_label(s, labels, to_light, n + 1, end, passed, &label);
            inside = label != 0;
        } else {
            n = follow_line(s, to_light, n, end, &inside);
            if (inside)
                label = find_surface_label(s, labels, near, offsets, place_on(to_light, (float)n));
        }
    }
    return light;
}

#endif
