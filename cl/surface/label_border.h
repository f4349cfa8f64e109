/* Vertices of one label's surface: those placed by HU, and those half way (-D LABELS).
 *
 * Between a dense sample of the label and one that is neither dense nor labelled, the vertex is that of the surface
 * without labels.  Everywhere else it lies half way, and its normal is that of the field "inside of the label". */
#ifndef CLRECON_LABEL_BORDER_H
#define CLRECON_LABEL_BORDER_H

#include "include/label_type.h"
#include "include/volume.h"
#include "surface/vertex_group.h"

/* For each sample the label that it is inside of, in the slices of the volume that a device holds. */
typedef struct {
    __global const LABEL *inside;
    uint label;
    float iso_level;
    __global uint *half_way_count;
} surface_border;

/* The parameters of a kernel for the border, the border itself, and whether it goes on beyond that of the volume. */
#define BORDER_PARAMETERS \
    , __global const LABEL *restrict inside, const uint label, __global uint *restrict half_way_count
#define SURFACE_BORDER { inside, label, iso_level, half_way_count }
#define BORDER_GOES_ON 0

/* The label that sample (i, j, k) is inside of; beyond the border of a closed volume none, of an open one the nearest. */
static inline uint sample_label(const surface_border *labels, const volume_part *volume, int i, int j, int k)
{
    const int ni = volume->ni, nj = volume->nj, nk = volume->nk;
    const int beyond = (i < 0) | (i >= ni) | (j < 0) | (j >= nj) | (k < 0) | (k >= nk);
    if (volume->closed && beyond)
        return 0;
    const int inside_k = clamp(k, 0, nk - 1) - volume->first_k;
    return labels->inside[voxel_index(clamp(i, 0, ni - 1), clamp(j, 0, nj - 1), inside_k, ni, nj)];
}

/* Turn lane n of a gathered group into a vertex half way, where HU do not place it; returns 1 then, else 0. */
static inline uint gather_border(
    vertex_group *group, uint n, const volume_part *volume, const surface_border *labels, int i, int j, int k, int axis,
    int inner)
{
    const int i1 = i + (axis == 0), j1 = j + (axis == 1), k1 = k + (axis == 2);
    const uint own = sample_label(labels, volume, i, j, k), other = sample_label(labels, volume, i1, j1, k1);
    const int own_dense = (float)group->value[n] >= labels->iso_level;
    const int other_dense = (float)group->next_value[n] >= labels->iso_level;
    const int placed = own == labels->label ? own_dense && !other_dense && other == 0
                                            : other_dense && !own_dense && own == 0;
    group->half_way[n] = !placed;
    if (placed)
        return 0;
#define INSIDE(i, j, k) ((VALUE)(sample_label(labels, volume, i, j, k) == labels->label))
    group->value[n] = INSIDE(i, j, k);
    group->next_value[n] = INSIDE(i1, j1, k1);
    const int ni = volume->ni, nj = volume->nj, nk = volume->nk, closed = volume->closed;
    group->gradient_i[n] = double_gradient(INSIDE(i - 1, j, k), INSIDE(i + 1, j, k), i, ni, closed);
    group->gradient_j[n] = double_gradient(INSIDE(i, j - 1, k), INSIDE(i, j + 1, k), j, nj, closed);
    group->gradient_k[n] = double_gradient(INSIDE(i, j, k - 1), INSIDE(i, j, k + 1), k, nk, closed);
    group->next_gradient_i[n] = double_gradient(INSIDE(i1 - 1, j1, k1), INSIDE(i1 + 1, j1, k1), i1, ni, closed);
    group->next_gradient_j[n] = double_gradient(INSIDE(i1, j1 - 1, k1), INSIDE(i1, j1 + 1, k1), j1, nj, closed);
    group->next_gradient_k[n] = double_gradient(INSIDE(i1, j1, k1 - 1), INSIDE(i1, j1, k1 + 1), k1, nk, closed);
#undef INSIDE
    return 1;
}

static inline void count_half_way(const surface_border *labels, const uint half_way)
{
    if (half_way != 0)
        atomic_add(labels->half_way_count, half_way);
}

#endif
