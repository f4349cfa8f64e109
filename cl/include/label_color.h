/* What labels do to a picture: a colour and an opacity each, of the label of the nearest voxel.
 *
 * The host's table has one float4 a label number: red, green, blue, opacity; red below 0 keeps the colour that is there
 * without labels.  Its first entry is that of no label. */
#ifndef CLRECON_LABEL_COLOR_H
#define CLRECON_LABEL_COLOR_H

#include "include/field.h"
#include "labels/label_type.h"

#define LABEL_TINT 0.8f /* share of a label's colour in what is coloured by HU already */

/* Label of the voxel nearest to a place in index coordinates; `labels` has the slices that the field has. */
static inline uint find_label(__global const LABEL *labels, const field *f, const float3 place)
{
    const int i = clamp((int)(place.x + 0.5f), 0, f->ni - 1), j = clamp((int)(place.y + 0.5f), 0, f->nj - 1);
    const int k = clamp((int)(place.z + 0.5f), f->first_k, f->end_k - 1);
    return labels[voxel_index(i, j, k - f->first_k, f->ni, f->nj)];
}

/* `color` with a share of a label's. */
static inline float3 tint(const float3 color, const float4 label_color, const float share)
{
    return label_color.x < 0.0f ? color : color + share * (label_color.xyz - color);
}

/* Opacity `factor` times what it was at the unit distance, whatever the step: `clear` is log2(1 - opacity) over one ray
 * step, `steps` how many of them make the unit distance; returned is the new log2(1 - opacity) over one ray step. */
static inline float fade(const float clear, const float factor, const float steps)
{
    return log2(max(1.0f - factor * (1.0f - exp2(clear * steps)), 1e-9f)) / steps;
}

#endif
