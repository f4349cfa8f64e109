/* The label that owns a dense sample: the one rule for surfaces of labels, in meshes and in pictures. */
#ifndef CLRECON_LABEL_OWNER_H
#define CLRECON_LABEL_OWNER_H

#include "include/label_type.h"
#include "include/volume.h"

/* Label of sample (i, j, k) of labels (nk, nj, ni); else that of the nearest sample that has one, the lowest of equally
 * near ones; 0 where there is none.  `near` has `offsets` steps along i, j, k and the number of their shell, nearest
 * first; offsets of one shell are equally long. */
static inline uint find_owner(
    __global const LABEL *labels, __global const int4 *near, const int offsets, const int i, const int j, const int k,
    const int ni, const int nj, const int nk)
{
    uint owner = labels[voxel_index(i, j, k, ni, nj)];
    if (owner != 0)
        return owner;
    int found_in = -1;
    for (int n = 0; n < offsets; ++n) {
        const int4 step = near[n];
        if (owner != 0 && step.w != found_in)
            break;
        const int i1 = i + step.x, j1 = j + step.y, k1 = k + step.z;
        if (i1 < 0 || i1 >= ni || j1 < 0 || j1 >= nj || k1 < 0 || k1 >= nk)
            continue;
        const uint label = labels[voxel_index(i1, j1, k1, ni, nj)];
        if (label != 0 && (owner == 0 || label < owner)) {
            owner = label;
            found_in = step.w;
        }
    }
    return owner;
}

#endif
