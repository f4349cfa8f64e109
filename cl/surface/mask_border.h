/* Vertices of a label's own surface: where the occupancy of its mask, and of its neighbours', puts them (-D MASKS).
 *
 * A sample is inside of the label whose number it carries, so each crossed edge has one end in the label:
 *
 *   other end            the vertex lies where
 *   without a label      the label's occupancy crosses its level; where other labels lie alongside, that of all labels
 *   another label        the leads of both labels, with their biases, are equal: the same point for both
 *   beyond the map       half way: the map ends at the faces of its voxels
 *
 * An end on the wrong side of the level counts as just on its own side, so that a vertex stays on its edge. */
#ifndef CLRECON_MASK_BORDER_H
#define CLRECON_MASK_BORDER_H

#include "include/label_type.h"
#include "include/volume.h"
#include "surface/label_masks.h"
#include "surface/vertex_group.h"

typedef struct {
    __global const LABEL *map; /* slices as those of `occupied` */
    volume_part occupied; /* occupancy of all labels together */
    uint label;
    int level;
    __global const int *biases; /* by label: by how much it comes before others, in units of the occupancy */
} surface_border;

/* The parameters of a kernel for the border, the border itself, and whether it goes on beyond that of the volume: edges
 * that lead out are placed apart from all others. */
#define BORDER_PARAMETERS \
    , __global const LABEL *restrict map, const uint label, __global const VOXEL *restrict occupied, \
        __global const int *restrict biases
#define SURFACE_BORDER \
    { map, {occupied, ni, nj, nk, first_slice, 0, outside}, label, (int)iso_level, biases }
#define BORDER_GOES_ON 1

/* Index `at` of an axis of n samples, held within it; drivers call clamp() as a function. */
static inline int hold_within(int at, int n)
{
    return at < 0 ? 0 : at >= n ? n - 1 : at;
}

/* Lead of label `own`, that of sample (i, j, k), over `other` there, in units of the occupancy; 1 at least. */
static inline int find_lead(const surface_border *masks, int i, int j, int k, uint own, uint other)
{
    const int ni = masks->occupied.ni, nj = masks->occupied.nj, nk = masks->occupied.nk;
    const int before_2 = hold_within(i - 2, ni), before_1 = hold_within(i - 1, ni);
    const int after_1 = hold_within(i + 1, ni), after_2 = hold_within(i + 2, ni);
    int lead = 0;
    for (int dk = -REACH; dk <= REACH; ++dk) {
        const int k1 = hold_within(k + dk, nk) - masks->occupied.first_k;
        for (int dj = -REACH; dj <= REACH; ++dj) {
            __global const LABEL *row = masks->map + voxel_index(0, hold_within(j + dj, nj), k1, ni, nj);
#define SIDE(at) ((row[at] == own) - (row[at] == other))
            lead += weigh(dk) * weigh(dj)
                * (SIDE(before_2) + SIDE(after_2) + 4 * (SIDE(before_1) + SIDE(after_1)) + 6 * SIDE(i));
#undef SIDE
        }
    }
    return lead > 0 ? FINENESS * lead : 1;
}

/* Set the values and gradients that place the vertex of lane n of a gathered group, which holds the occupancy of the
 * label.  Returns 0: none counts as half way. */
static inline uint gather_border(
    vertex_group *group, uint n, const volume_part *volume, const surface_border *masks, int i, int j, int k, int axis,
    int inner)
{
    const volume_part *all = &masks->occupied;
    const int i1 = i + (axis == 0), j1 = j + (axis == 1), k1 = k + (axis == 2), level = masks->level;
    const int enters = i < 0 || j < 0 || k < 0, leaves = i1 >= all->ni || j1 >= all->nj || k1 >= all->nk;
    if (enters || leaves) {
        group->value[n] = level + (enters ? -1 : 1);
        group->next_value[n] = level + (enters ? 1 : -1);
        group->gradient_i[n] = group->gradient_j[n] = group->gradient_k[n] = 0;
        group->next_gradient_i[n] = group->next_gradient_j[n] = group->next_gradient_k[n] = 0;
        return 0;
    }
    const uint here = masks->map[voxel_index(i, j, k - all->first_k, all->ni, all->nj)];
    const uint there = masks->map[voxel_index(i1, j1, k1 - all->first_k, all->ni, all->nj)];
    const int begins = here == masks->label; /* the label is at the near end of the edge */
    if (here != 0 && there != 0) {
        const int before = masks->biases[here] - masks->biases[there];
        const int lead = max(find_lead(masks, i, j, k, here, there) + before, 1);
        const int next_lead = max(find_lead(masks, i1, j1, k1, there, here) - before, 1);
        group->value[n] = level + (begins ? lead : -lead);
        group->next_value[n] = level + (begins ? -next_lead : next_lead);
        return 0;
    }
    const int others = all->voxels[voxel_index(i, j, k - all->first_k, all->ni, all->nj)] - group->value[n];
    const int next_others
        = all->voxels[voxel_index(i1, j1, k1 - all->first_k, all->ni, all->nj)] - group->next_value[n];
    /* Others that are denser at the label's end lie alongside; across a gap they are denser at the far end. */
    if ((others | next_others) != 0 && (begins ? others >= next_others : next_others >= others))
        gather_vertex(group, n, all, i, j, k, axis, inner);
    if (begins) {
        group->value[n] = max(group->value[n], level + 1);
        group->next_value[n] = min(group->next_value[n], level - 1);
    } else {
        group->value[n] = min(group->value[n], level - 1);
        group->next_value[n] = max(group->next_value[n], level + 1);
    }
    return 0;
}

static inline void count_half_way(const surface_border *masks, const uint half_way) {}

#endif
