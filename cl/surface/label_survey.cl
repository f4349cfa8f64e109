/* Survey of a label map: the box of each label, and the number of faces that its voxels share with other labels.
 *
 * Passes
 *   1. clear_survey
 *   2. find_boxes
 *   3. count_faces */
#include "include/label_type.h"
#include "include/volume.h"
#include "include/mask_rows.h"

/* 16 labels, and whether any bit of them is set: without conversions, which some drivers call as functions. */
#define JOIN_NAMES(a, b) a##b
#define JOIN(a, b) JOIN_NAMES(a, b)
#define LABEL16 JOIN(LABEL, 16)
#define ANY_BIT(labels) JOIN(any_bit_, LABEL)(labels)

static inline int any_bit_uchar(uchar16 labels)
{
    const ulong2 parts = as_ulong2(labels);
    return (parts.x | parts.y) != 0;
}

static inline int any_bit_ushort(ushort16 labels)
{
    const ulong4 parts = as_ulong4(labels);
    return (parts.x | parts.y | parts.z | parts.w) != 0;
}

/* Parameters  boxes    out  (labels, 6) highest int three times, lowest int three times: no box yet
 *             faces    out  (labels, 2) 0
 *             labels
 * Launch      global = labels rounded up by the host, any local */
__kernel void clear_survey(__global int *restrict boxes, __global uint *restrict faces, const uint labels)
{
    const uint item = get_global_id(0);
    if (item >= labels)
        return;
    for (uint axis = 0; axis < 3; ++axis) {
        boxes[6 * item + axis] = INT_MAX;
        boxes[6 * item + 3 + axis] = INT_MIN;
    }
    faces[2 * item] = faces[2 * item + 1] = 0;
}

/* Widen the box of a label by samples begin .. end - 1 of row (j, k). */
static inline void widen_box(__global int *box, int begin, int end, int j, int k)
{
    atomic_min(box, begin);
    atomic_min(box + 1, j);
    atomic_min(box + 2, k);
    atomic_max(box + 3, end - 1);
    atomic_max(box + 4, j);
    atomic_max(box + 5, k);
}

/* Parameters  map      in      (nk, nj, ni)
 *             boxes    in/out  (labels, 6) lowest i, j, k of each label, highest i, j, k; from clear_survey
 *             ni nj nk
 * Launch      global = nk * nj rounded up by the host, any local: one item a row
 * Races       items widen the same box by atomic minimum and maximum: in any order with the same outcome
 * Guarantees  boxes are those of all samples of the label; label 0 is left out */
__kernel void find_boxes(
    __global const LABEL *restrict map, __global int *restrict boxes, const int ni, const int nj, const int nk)
{
    const uint item = get_global_id(0);
    if (item >= (uint)nj * (uint)nk)
        return;
    const int j = (int)(item % nj), k = (int)(item / nj);
    __global const LABEL *row = map + voxel_index(0, j, k, ni, nj);
    uint open = 0; /* the label whose samples begin .. end - 1 of the row are not in its box yet */
    int begin = 0, end = 0, i = 0;
    while (i < ni) {
        const LABEL label = row[i];
        const int first = i++;
        while (i + 16 <= ni && pack_lanes(convert_short16(vload16(0, row + i) != label)) == 0)
            i += 16;
        while (i < ni && row[i] == label)
            ++i;
        if (label == 0)
            continue;
        if (label != open) {
            if (open != 0)
                widen_box(boxes + 6 * (size_t)open, begin, end, j, k);
            open = label;
            begin = first;
        }
        end = i;
    }
    if (open != 0)
        widen_box(boxes + 6 * (size_t)open, begin, end, j, k);
}

/* The faces that an item has found and not added to a label's yet. */
typedef struct {
    uint label, free, shared;
} found_faces;

static inline void add_faces(__global uint *faces, found_faces *found)
{
    if (found->free != 0)
        atomic_add(faces + 2 * (size_t)found->label, found->free);
    if (found->shared != 0)
        atomic_add(faces + 2 * (size_t)found->label + 1, found->shared);
    found->free = found->shared = 0;
}

/* Count the face between samples that carry `label` and `other`, for the first of them. */
static inline void count_face(__global uint *faces, found_faces *found, LABEL label, LABEL other)
{
    if (label == 0 || label == other)
        return;
    if (label != found->label) {
        add_faces(faces, found);
        found->label = label;
    }
    found->free += other == 0;
    found->shared += other != 0;
}

/* Parameters  map      in      (nk, nj, ni)
 *             faces    in/out  (labels, 2) grows by the faces of each label towards samples without a label, and towards
 *                              those of other labels; from clear_survey
 *             ni nj nk
 * Launch      global = nk * nj rounded up by the host, any local: one item a row, with the faces towards the next ones
 * Races       items add to the same counts atomically: in any order with the same outcome
 * Guarantees  the ends of the map count as no faces */
__kernel void count_faces(
    __global const LABEL *restrict map, __global uint *restrict faces, const int ni, const int nj, const int nk)
{
    const uint item = get_global_id(0);
    if (item >= (uint)nj * (uint)nk)
        return;
    const int j = (int)(item % nj), k = (int)(item / nj);
    __global const LABEL *row = map + voxel_index(0, j, k, ni, nj);
    const size_t along_j = j + 1 < nj ? (size_t)ni : 0, along_k = k + 1 < nk ? (size_t)ni * (size_t)nj : 0;
    found_faces near = {0, 0, 0}, far = {0, 0, 0}; /* of the row's own samples, of those next to them */
    for (int first = 0; first < ni; first += 16) {
        if (first + 17 <= ni) {
            const LABEL16 own = vload16(0, row + first);
            if (!ANY_BIT((own ^ vload16(0, row + first + 1)) | (own ^ vload16(0, row + first + along_j))
                    | (own ^ vload16(0, row + first + along_k))))
                continue;
        }
        for (int i = first; i < min(first + 16, ni); ++i) {
            const LABEL own = row[i], next[3] = {row[min(i + 1, ni - 1)], row[i + along_j], row[i + along_k]};
            for (uint axis = 0; axis < 3; ++axis) {
                count_face(faces, &near, own, next[axis]);
                count_face(faces, &far, next[axis], own);
            }
        }
    }
    add_faces(faces, &near);
    add_faces(faces, &far);
}
