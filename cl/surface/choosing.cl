/* Choosing: the components of runs of cells that are grown, after cl/surface/growing.cl has joined them.
 *
 * Passes, of which those are launched that are asked for
 *   find_largest, choose_largest   the largest components
 *   choose_cells                   those of given cells
 *   choose_seeded                  those whose cells have a corner in a mask
 *   sum_components                 at last: how many there are, and their cells
 *
 * Races.  Where many items write one word they do so by atomic operations whose order does not count.
 *
 * Of growing.cl: run_starts and word_runs of find_cell_runs, row_offsets (gk, gj) runs of all rows before each, roots
 * (runs,) the smallest run of each run's component, run_cells (runs,) at each root the cells of its component. */
#include "include/mask_rows.h"
#include "surface/cell_runs.h"
#include "surface/component_sums.h"

/* Parameters  roots      in      (runs,)
 *             run_cells  in      (runs,) at each root the cells of its component
 *             sums       in/out  (SUMS,) LARGEST: 0; then the cells of the largest component
 *             runs
 * Launch      global = runs rounded up by the host, any local */
__kernel void find_largest(
    __global const uint *restrict roots, __global const uint *restrict run_cells, volatile __global uint *sums,
    const uint runs)
{
    const uint run = get_global_id(0);
    if (run < runs && roots[run] == run)
        atomic_max(sums + LARGEST, run_cells[run]);
}

/* Parameters  roots, run_cells, runs   in   as above
 *             sums       in      (SUMS,) of find_largest
 *             parts      the components with at least one of so many parts of the largest are chosen
 *             chosen     in/out  (runs,) 1 at the roots of chosen components
 * Launch      as find_largest */
__kernel void choose_largest(
    __global const uint *restrict roots, __global const uint *restrict run_cells, __global const uint *restrict sums,
    __global uint *restrict chosen, const uint parts, const uint runs)
{
    const uint run = get_global_id(0);
    if (run < runs && roots[run] == run && (ulong)run_cells[run] * parts >= sums[LARGEST])
        chosen[run] = 1;
}

/* Parameters  roots, run_cells, chosen, runs   in   as above
 *             sums       in/out  (SUMS,) 0; then components, those chosen, their cells, and the most cells of one that is
 *                        not chosen
 * Launch      as find_largest */
__kernel void sum_components(
    __global const uint *restrict roots, __global const uint *restrict run_cells, __global const uint *restrict chosen,
    volatile __global uint *sums, const uint runs)
{
    const uint run = get_global_id(0);
    if (run >= runs || roots[run] != run)
        return;
    const uint cells = run_cells[run];
    atomic_inc(sums + COMPONENTS);
    if (atomic_add(sums + ACTIVE_CELLS, cells) > ~0u - cells)
        atomic_inc(sums + ACTIVE_CELLS + 1);
    if (chosen[run] == 0) {
        atomic_max(sums + LARGEST_LEFT_OUT, cells);
        return;
    }
    atomic_inc(sums + CHOSEN);
    if (atomic_add(sums + CHOSEN_CELLS, cells) > ~0u - cells)
        atomic_inc(sums + CHOSEN_CELLS + 1);
}

/* Parameters  run_starts, word_runs, row_offsets, roots   in   of growing.cl
 *             cells    in      (n,) active cells: x, y, z are i, j, k, w is not used
 *             chosen   in/out  (runs,) 1 at the roots of components that have one of these cells
 *             n        cells
 *             gj, words   as above
 * Launch      global = n rounded up by the host, any local */
__kernel void choose_cells(
    __global const uint *restrict run_starts, __global const ushort *restrict word_runs,
    __global const uint *restrict row_offsets, __global const uint *restrict roots,
    __global const uint4 *restrict cells, volatile __global uint *chosen, const uint n, const uint gj, const uint words)
{
    const uint number = get_global_id(0);
    if (number >= n)
        return;
    const uint4 cell = cells[number];
    const uint row = cell.z * gj + cell.y;
    const size_t at = (size_t)row * words + (cell.x >> 5);
    const uint upto = ~0u >> (31 - (cell.x & 31));
    const uint run = row_offsets[row] + word_runs[at] + popcount(run_starts[at] & upto) - 1;
    atomic_or(chosen + roots[run], 1u);
}

/* Parameters  mask, run_starts, word_runs, run_extents, row_offsets, roots   in   of growing.cl
 *             seeds        in   (nk, nj, voxel_words) voxels that are seeds, without a border
 *             chosen       in/out  (runs,) 1 at the roots of components, a cell of which has an enclosed corner that is a
 *                          seed
 *             enclosed_set   1 where set bits of the mask are enclosed by the surface, 0 where the others are
 *             border       layers of samples around the volume, 0 or 1
 *             voxel_words  words of a row of `seeds`
 *             gi gj gk     samples; words of a row
 * Launch      global = gj * gk rounded up by the host, any local
 * Guarantees  every component with a seed is chosen */
__kernel void choose_seeded(
    __global const uint *restrict mask, __global const uint *restrict run_starts,
    __global const ushort *restrict word_runs, __global const ushort2 *restrict run_extents,
    __global const uint *restrict row_offsets, __global const uint *restrict seeds,
    __global const uint *restrict roots, volatile __global uint *chosen,
    const int enclosed_set, const uint border, const uint voxel_words,
    const uint gi, const uint gj, const uint gk, const uint words)
{
    const uint row = get_global_id(0);
    if (row >= gj * gk)
        return;
    const uint j = row % gj, k = row / gj;
    const ushort2 extent = run_extents[row];
    uint run = row_offsets[row], found = 0;
    for (uint w = extent.x; w < extent.y; ++w) {
        cell_rows rows;
        load_cell_rows(&rows, mask, j, k, w, gj, words);
        const uint active = find_active_cells(rows, w, gi);
        ulong corners = 0;
#define CORNERS(bits, j, k) \
        ((load_seeds(seeds, j, k, w, gj, gk, border, voxel_words) \
            | (ulong)(w + 1 < words ? load_seeds(seeds, j, k, w + 1, gj, gk, border, voxel_words) : 0) << 32) \
            & (enclosed_set ? (bits) : ~(bits)))
        if (active != 0)
            corners = CORNERS(rows.y0z0, j, k) | CORNERS(rows.y1z0, j + 1, k) | CORNERS(rows.y0z1, j, k + 1)
                | CORNERS(rows.y1z1, j + 1, k + 1);
#undef CORNERS
        uint seeds_here = active & (uint)(corners | corners >> 1);
        for (uint starts = run_starts[(size_t)row * words + w]; starts != 0; starts &= starts - 1) {
            const uint before = (1u << lowest_bit(starts)) - 1;
            if (found | ((seeds_here & before) != 0))
                atomic_or(chosen + roots[run - 1], 1u);
            seeds_here &= ~before;
            found = 0;
            ++run;
        }
        found |= seeds_here != 0;
    }
    if (found)
        atomic_or(chosen + roots[run - 1], 1u);
}
