/* Labels in a picture: the colour and opacity of the label of the nearest voxel.
 *
 * The host's table has one float4 for each label number: red, green, blue, opacity; red below 0 keeps the colour of the
 * picture without labels.  Its first entry is that of no label. */
#ifndef CLRECON_LABEL_COLOR_H
#define CLRECON_LABEL_COLOR_H

#include "include/label_type.h"
#include "rays/field.h"

#define LABEL_TINT 0.8f /* share of a label's colour in what is coloured by HU already */

/* Label of the voxel nearest to a place in index coordinates; `labels` has the slices that the field has. */
static inline uint find_label(__global const LABEL *labels, const field *f, const float3 place)
{
    const int i = clamp((int)(place.x + 0.5f), 0, f->ni - 1), j = clamp((int)(place.y + 0.5f), 0, f->nj - 1);
    const int k = clamp((int)(place.z + 0.5f), f->first_k, f->end_k - 1);
    return labels[voxel_index(i, j, k - f->first_k, f->ni, f->nj)];
}

/* Numbers of the labels of the voxels nearest to LANES places near each other. */
static inline ints find_labels(
    __global const LABEL *labels, const field *f, const floats i, const floats j, const floats k)
{
    const ints voxel_i = clamp(to_ints(i + 0.5f), (ints)(0), (ints)(f->ni - 1));
    const ints voxel_j = clamp(to_ints(j + 0.5f), (ints)(0), (ints)(f->nj - 1));
    const ints voxel_k = clamp(to_ints(k + 0.5f), (ints)(f->first_k), (ints)(f->end_k - 1));
    const int base_i = FIRST_LANE(voxel_i), base_j = FIRST_LANE(voxel_j), base_k = FIRST_LANE(voxel_k);
    __global const LABEL *first = labels + voxel_index(base_i, base_j, base_k - f->first_k, f->ni, f->nj);
    const ints at = ((voxel_k - base_k) * f->nj + (voxel_j - base_j)) * f->ni + (voxel_i - base_i);
    return (ints)(GATHER(LABEL, first, at));
}

/* One of red, green, blue and opacity (0 to 3) of labels. */
#define LABEL_CHANNEL(label_colors, number, channel) \
    ((floats)(GATHER(float, (__global const float *)(label_colors) + (channel), 4 * (number))))

/* `color` with a share of a label's. */
static inline float3 tint(const float3 color, const float4 label_color, const float share)
{
    return label_color.x < 0.0f ? color : color + share * (label_color.xyz - color);
}

#endif
