/* Cells with few points, and growth over the others: paper B's removal of noise from clouds of points.
 *
 * Reference: Liu et al. 2019, "Vertebrae CT images 3D reconstruction with improved marching cubes algorithm", section
 * 2.2; growth over 26 neighbours as connected components, by rounds of hooking as in primitives/union_find.cl.
 *
 * Cells in a plane, with the number of points in each; `fewest` is 2, the threshold 5:
 *
 *      1 . 7 2     1: sparse, its point goes
 *      . 3 2 .     7, 2, 3, 2: grown from the cell with 7 over neighbours by faces, edges and corners
 *      . . . .
 *      2 3 . 1     2, 3: no cell here has 5 points, so growth never begins: not reached
 *
 * Passes
 *   1. label_crowded    a label for each cell with enough points: itself
 *   2. hook_touching    neighbouring cells, in rounds with jump_labels of primitives/union_find.cl
 *   3. mark_places      what becomes of each point, from what becomes of its cell
 *
 * Races.  hook_touching reads labels that no item writes, and writes by atomic_min() what none reads; all who write its
 * flag write the same.  Of the others each item writes words of its own. */
#include "points/grid.h"

#define SPARSE 0xffffffffu

__constant char half_y[5] = { 0, 1, -1, 0, 1 };
__constant char half_z[5] = { 0, 0, 1, 1, 1 };

/* Parameters  starts  in   (cells + 1,)
 *             labels  out  (cells,) the cell itself where it has at least `fewest` points, else SPARSE
 *             cells   with points
 * Launch      global = cells rounded up by the host, any local
 * Guarantees  every label is written */
__kernel void label_crowded(
    __global const uint *restrict starts, __global uint *restrict labels, const uint cells, const uint fewest)
{
    const uint cell = get_global_id(0);
    if (cell < cells)
        labels[cell] = starts[cell + 1] - starts[cell] >= fewest ? cell : SPARSE;
}

/* Parameters  x y z   in      (n,) sorted coordinates
 *             starts  in      (cells + 1,);  mask, ranks: in (nz, ny, words);  see points/grid.h
 *             labels  in      (cells,) all of them roots, or SPARSE
 *             hooked  in/out  (cells,) roots as labels; then the least root of a neighbour of each, where that is less
 *             flags   out     [1]: pass_number where a root was hooked, else as it was
 *             origin  corner of cell (0, 0, 0), 1 / edge
 *             pass_number  counts from 1
 * Launch      global = cells rounded up by the host, any local
 * Guarantees  without the flag neighbouring cells have one root */
__kernel void hook_touching(
    __global const float *restrict x, __global const float *restrict y, __global const float *restrict z,
    __global const uint *restrict starts, __global const uint *restrict mask, __global const uint *restrict ranks,
    __global const uint *restrict labels, __global uint *hooked, __global uint *flags, const float4 origin,
    const int nx, const int ny, const int nz, const int words, const uint cells, const uint pass_number)
{
    const uint cell = get_global_id(0);
    if (cell >= cells || labels[cell] == SPARSE)
        return;
    const uint root = labels[cell], point = starts[cell];
    const int4 where = grid_cell(x[point], y[point], z[point], origin, nx, ny, nz);
    for (int half_row = 0; half_row < 5; ++half_row) {
        const int ry = where.y + half_y[half_row], rz = where.z + half_z[half_row];
        if (ry < 0 || ry >= ny || rz >= nz)
            continue;
        const uint2 window = grid_window(
            mask, ranks, grid_row(ry, rz, ny, words), max(where.x - 1, 0), min(where.x + 1, nx - 1));
        for (uint other = half_row == 0 ? cell + 1 : window.x; other < window.y; ++other) {
            const uint other_root = labels[other];
            if (other_root == SPARSE || other_root == root)
                continue;
            atomic_min(hooked + max(root, other_root), min(root, other_root));
            flags[1] = pass_number;
        }
    }
}

/* Parameters  starts  in   (cells + 1,)
 *             order   in   (n,) number of the point at each place
 *             kinds   in   (cells,) what becomes of each cell
 *             marks   out  (n,) the same for each point, in the order of the input
 *             cells   with points
 * Launch      global = cells rounded up by the host, any local
 * Guarantees  every mark is written */
__kernel void mark_places(
    __global const uint *restrict starts, __global const uint *restrict order, __global const uchar *restrict kinds,
    __global uchar *restrict marks, const uint cells)
{
    const uint cell = get_global_id(0);
    if (cell >= cells)
        return;
    const uint end = starts[cell + 1];
    for (uint at = starts[cell]; at < end; ++at)
        marks[order[at]] = kinds[cell];
}
