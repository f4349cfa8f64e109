/* The closed field: a volume surrounded by a layer of `outside`, the field of closed surfaces.
 *
 * One index step beyond the outermost voxel centres the field has reached `outside`; in between it is linear. */
#ifndef CLRECON_CLOSED_FIELD_H
#define CLRECON_CLOSED_FIELD_H

#include "rays/field.h"
#include "rays/hit.h"

typedef struct {
    field inner;
    float level, outside; /* inside is >= level; outside < level */
} closed_field;

/* Share that the outermost voxel has of the field: 1 between the voxel centres, 0 from one step beyond. */
static inline floats inner_share(const floats at, const float last)
{
    return clamp(min(at + 1.0f, last + 1.0f - at), (floats)(0.0f), (floats)(1.0f));
}

/* Values at LANES places near each other, index coordinates. */
static inline floats sample_closed(const closed_field *f, const floats i, const floats j, const floats k)
{
    const floats value = sample_lanes(&f->inner, i, j, k, 0);
    const float4 last = f->inner.last;
    const floats share = inner_share(i, last.x) * inner_share(j, last.y) * inner_share(k, last.z);
    /* A value on the level stays on it. */
    return choose(share < 1.0f, f->outside + share * (value - f->outside), value);
}

static inline float read_closed(const closed_field *f, const int i, const int j, const int k)
{
    const field *inner = &f->inner;
    const int beyond = (i < 0) | (j < 0) | (k < 0) | (i > (int)inner->last.x) | (j > (int)inner->last.y)
        | (k > (int)inner->last.z);
    const int held_k = clamp(k, inner->first_k, inner->end_k - 1) - inner->first_k;
    const int held_i = clamp(i, 0, inner->ni - 1), held_j = clamp(j, 0, inner->nj - 1);
    const float value = (float)inner->voxels[voxel_index(held_i, held_j, held_k, inner->ni, inner->nj)];
    return beyond ? f->outside : value;
}

/* Central differences per index step at the corners (i or i + 1, j or j + 1) of slice k, weighed by the parts. */
static inline float4 mix_closed_differences(
    const closed_field *f, const int i, const int j, const int k, const float part_i, const float part_j)
{
    float4 mean = (float4)(0.0f);
    for (int b = 0; b < 2; ++b)
        for (int a = 0; a < 2; ++a) {
            const float weight = (a ? part_i : 1.0f - part_i) * (b ? part_j : 1.0f - part_j);
            const int x = i + a, y = j + b;
            mean += 0.5f * weight
                * (float4)(read_closed(f, x + 1, y, k) - read_closed(f, x - 1, y, k),
                           read_closed(f, x, y + 1, k) - read_closed(f, x, y - 1, k),
                           read_closed(f, x, y, k + 1) - read_closed(f, x, y, k - 1), 0.0f);
        }
    return mean;
}

/* Central differences per index step, interpolated within the slices below and above a place: see find_differences(),
 * which serves where no neighbour is beyond the border. */
static inline float find_closed_differences(const closed_field *f, const float3 place, float4 *below, float4 *above)
{
    const float4 last = f->inner.last;
    if (place.x >= 1.0f && place.y >= 1.0f && place.z >= 1.0f && place.x < last.x - 1.0f && place.y < last.y - 1.0f
        && place.z < last.z - 1.0f)
        return find_differences(&f->inner, place, below, above);
    const float3 at = clamp(place, (float3)(-1.0f), last.xyz + 1.0f);
    const int i = min((int)floor(at.x), (int)last.x), j = min((int)floor(at.y), (int)last.y);
    const int k = min((int)floor(at.z), (int)last.z);
    const float part_i = at.x - (float)i, part_j = at.y - (float)j;
    *below = mix_closed_differences(f, i, j, k, part_i, part_j);
    *above = mix_closed_differences(f, i, j, k + 1, part_i, part_j);
    return at.z - (float)k;
}

#endif
