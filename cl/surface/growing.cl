/* Growing: the active cells of an iso surface that hang together with seeds, found before anything is emitted.
 *
 * References: Liu et al. 2019, "Vertebrae CT Images 3D Reconstruction with Improve Marching Cubes Algorithm", J. Harbin
 * Inst. Technol. 26(6) (growing through mixed faces); Jayanti and Tarjan 2016, "A randomized concurrent algorithm for
 * disjoint set union" (joining by compare-and-swap); the runs of cells and the mask of kept edges are our own.
 *
 * Two active cells with a common face belong together where the face is mixed: one to three of its four corners are
 * inside.  A run is a piece of a row of cells that belong together one by one.
 *
 *      cells of a row   . a a a | a a . a a         |: the face between is not mixed, both cells are active
 *      runs               0 0 0   1 1   2 2         run_starts has a bit where a run begins
 *
 * Passes
 *   1. find_cell_runs      runs of each row of cells; per word the runs of the row that begin before it
 *      (exclusive scan of the runs of all rows: cl/primitives/scan.cl)
 *   2. begin_cell_runs     each run by itself, without cells and not chosen
 *   3. join_cell_runs      runs of neighbouring rows with a mixed face between them
 *   4. find_run_roots      the smallest run of each component, and there the component's cells
 *      (the components that are grown are chosen: cl/surface/choosing.cl)
 *   5. mark_grown          bits of the samples whose edges belong to chosen components
 *   6. count_visited       grown cells and their neighbours
 *
 * The grown samples.  All cells around a crossed edge are active and belong to one component, so an edge is grown or it
 * is not, and one of its cells says which: that of the sample that owns the edge, or at the far ends of the grid, where
 * that cell does not exist, the last one before.  A bit a sample therefore tells the grown ones of the crossed edges, and
 * of the active cells too; cl/surface/cells.cl and cl/surface/marching_cubes.cl take them with -D GROWN.
 *
 * Races.  join_cell_runs is the only pass where items read what others write in the same launch.  A parent is never above
 * its run: at roots it is set by atomic_cmpxchg(), from the root itself to a smaller run of the same component; at other
 * runs to the parent's parent.  A parent that an item reads too early was a parent a moment ago, so following
 * it leads to the same component, and the swap of one that is no root any more fails and says the new one.  No item
 * waits for another.  A root is the smallest run of its component whatever the order: the outcome is the same on every
 * device.  Where other passes write one word from many items they do so by atomic operations whose order does not
 * count. */
#include "include/mask_rows.h"
#include "surface/cell_runs.h"
#include "surface/component_sums.h"

/* Parameters  mask         in   (gk, gj, words) inside mask of the whole grid
 *             row_extents  in   (gk, gj) first word of the row with a bit set, and the one after the last
 *             active_cells out  (gk, gj, words) bit b: cell b of the word is active
 *             run_starts   out  (gk, gj, words) bit b: a run begins there
 *             word_runs    out  (gk, gj, words) runs of the row that begin before each word
 *             row_runs     out  (gk, gj) runs of each row
 *             run_extents  out  (gk, gj) words of the row that may have active cells: first, and the one after the last
 *             gi gj gk     samples; words of a row
 * Launch      global = gj * gk rounded up by the host, any local
 * Assumes     gi < 65536
 * Guarantees  row_runs and run_extents are written, words within the extents of a row too; rows of samples without a
 *             row of cells have none */
__kernel void find_cell_runs(
    __global const uint *restrict mask, __global const ushort2 *restrict row_extents,
    __global uint *restrict active_cells, __global uint *restrict run_starts, __global ushort *restrict word_runs,
    __global uint *restrict row_runs, __global ushort2 *restrict run_extents,
    const uint gi, const uint gj, const uint gk, const uint words)
{
    const uint row = get_global_id(0);
    if (row >= gj * gk)
        return;
    const uint j = row % gj, k = row / gj;
    uint begin = words, end = 0, runs = 0;
    if (j + 1 < gj && k + 1 < gk) {
        const ushort2 extents[4] = {row_extents[row], row_extents[row + 1], row_extents[row + gj],
            row_extents[row + gj + 1]};
        for (uint around = 0; around < 4; ++around) {
            if (extents[around].x < extents[around].y) {
                begin = min(begin, (uint)extents[around].x);
                end = max(end, (uint)extents[around].y);
            }
        }
        begin -= begin != 0;
    }
    begin = min(begin, end);
    row_runs[row] = 0;
    run_extents[row] = (ushort2)((ushort)begin, (ushort)end);
    if (begin == end)
        return;
    __global const uint *y0z0 = mask + (size_t)row * words;
    __global const uint *y1z0 = y0z0 + words;
    __global const uint *y0z1 = y0z0 + (size_t)gj * words;
    __global const uint *y1z1 = y0z1 + words;
    cell_rows rows = {y0z0[begin], y1z0[begin], y0z1[begin], y1z1[begin]};
    for (uint w = begin; w < end; ++w) {
        const uint next = w + 1 < words ? w + 1 : w;
        const cell_rows next_rows = {y0z0[next], y1z0[next], y0z1[next], y1z1[next]};
        rows.y0z0 |= next_rows.y0z0 << 32;
        rows.y1z0 |= next_rows.y1z0 << 32;
        rows.y0z1 |= next_rows.y0z1 << 32;
        rows.y1z1 |= next_rows.y1z1 << 32;
        const corner_columns columns = join_rows(rows);
        const uint active = (uint)((columns.any | columns.any >> 1) & ~(columns.all & columns.all >> 1)
            & samples_with_next(w, gi));
        const uint starts = active & (~(uint)(columns.any ^ columns.all) | (w == 0));
        active_cells[(size_t)row * words + w] = active;
        run_starts[(size_t)row * words + w] = starts;
        word_runs[(size_t)row * words + w] = (ushort)runs;
        runs += popcount(starts);
        rows = next_rows;
    }
    row_runs[row] = runs;
}

/* Parameters  parents    out  (runs,) each run's own number
 *             run_cells  out  (runs,) 0
 *             chosen     out  (runs,) 0
 *             sums       out  (SUMS,) 0
 *             runs
 * Launch      global = runs rounded up by the host, any local
 * Guarantees  every run is written once */
__kernel void begin_cell_runs(
    __global uint *restrict parents, __global uint *restrict run_cells, __global uint *restrict chosen,
    __global uint *restrict sums, const uint runs)
{
    const uint run = get_global_id(0);
    if (run >= runs)
        return;
    parents[run] = run;
    run_cells[run] = 0;
    chosen[run] = 0;
    if (run == 0) {
        for (uint n = 0; n < SUMS; ++n)
            sums[n] = 0;
    }
}

/* Parameters  mask, active_cells, run_starts, word_runs, run_extents   in   of find_cell_runs
 *             row_offsets  in      (gk, gj)
 *             parents      in/out  (runs,) begun; then each run has a parent of its component that is not above it
 *             gi gj gk, words   as above
 * Launch      as find_cell_runs
 * Guarantees  two runs lead to one root where mixed faces join them; the root is the smallest run */
__kernel void join_cell_runs(
    __global const uint *restrict mask, __global const uint *restrict active_cells,
    __global const uint *restrict run_starts,
    __global const ushort *restrict word_runs, __global const ushort2 *restrict run_extents,
    __global const uint *restrict row_offsets, volatile __global uint *parents,
    const uint gi, const uint gj, const uint gk, const uint words)
{
    const uint row = get_global_id(0);
    if (row >= gj * gk)
        return;
    const ushort2 extent = run_extents[row];
    if (extent.x >= extent.y)
        return;
    const uint j = row % gj, k = row / gj;
    const ushort2 none = (ushort2)(0, 0);
    const ushort2 next_y = j + 2 < gj ? run_extents[row + 1] : none;
    const ushort2 next_z = k + 2 < gk ? run_extents[row + gj] : none;
    if (next_y.x >= next_y.y && next_z.x >= next_z.y)
        return;
    uint mixed_y_before = 0, mixed_z_before = 0;
    for (uint w = extent.x; w < extent.y; ++w) {
        if (active_cells[(size_t)row * words + w] == 0) {
            mixed_y_before = mixed_z_before = 0;
            continue;
        }
        const ulong y0z1 = load_window(mask, row + gj, w, words), y1z1 = load_window(mask, row + gj + 1, w, words);
        if (w >= next_y.x && w < next_y.y)
            join_word(parents, run_starts, word_runs, row_offsets, row, row + 1, w, words,
                find_mixed_faces(load_window(mask, row + 1, w, words), y1z1, w, gi), 0, &mixed_y_before);
        if (w >= next_z.x && w < next_z.y) {
            const uint mixed = find_mixed_faces(y0z1, y1z1, w, gi);
            uint joined = 0;
            if (j > 0 && mixed != 0) {
                /* Round the edge that four cells share: by the row before, both cells are joined to its own already. */
                const ulong own = load_window(mask, row, w, words);
                const ulong before = load_window(mask, row + gj - 1, w, words);
                const ulong beyond = load_window(mask, row + 2 * gj, w, words);
                joined = find_mixed_faces(before, y0z1, w, gi) & find_mixed_faces(own, y0z1, w, gi)
                    & find_mixed_faces(y0z1, beyond, w, gi);
            }
            join_word(parents, run_starts, word_runs, row_offsets, row, row + gj, w, words, mixed, joined,
                &mixed_z_before);
        }
    }
}

/* Parameters  active_cells, run_starts, run_extents   in   of find_cell_runs
 *             row_offsets  in      (gk, gj) runs of all rows before each
 *             parents      in      (runs,) joined
 *             roots        out     (runs,) the smallest run of each run's component
 *             run_cells    in/out  (runs,) 0; then at each root the cells of its component, at other runs 0
 *             gj gk, words   as above
 * Launch      as find_cell_runs
 * Assumes     a component has fewer than 2^32 cells
 * Guarantees  every run is written */
__kernel void find_run_roots(
    __global const uint *restrict active_cells, __global const uint *restrict run_starts,
    __global const ushort2 *restrict run_extents, __global const uint *restrict row_offsets,
    __global const uint *restrict parents, __global uint *restrict roots, volatile __global uint *run_cells,
    const uint gj, const uint gk, const uint words)
{
    const uint row = get_global_id(0);
    if (row >= gj * gk)
        return;
    const ushort2 extent = run_extents[row];
    /* Runs that follow each other are often of one component: their cells are added up before they are added to it. */
    uint run = row_offsets[row], root = 0, cells = 0;
    for (uint w = extent.x; w < extent.y; ++w) {
        uint active = active_cells[(size_t)row * words + w];
        for (uint starts = run_starts[(size_t)row * words + w]; starts != 0; starts &= starts - 1) {
            const uint before = (1u << lowest_bit(starts)) - 1;
            cells += popcount(active & before);
            active &= ~before;
            const uint next_root = find_root(parents, run);
            if (next_root != root && cells != 0) {
                atomic_add(run_cells + root, cells);
                cells = 0;
            }
            root = next_root;
            roots[run++] = root;
        }
        cells += popcount(active);
    }
    if (cells != 0)
        atomic_add(run_cells + root, cells);
}

/* Parameters  active_cells, run_starts, run_extents, row_offsets, roots   in   as above
 *             chosen   in   (runs,) 1 at the roots of chosen components
 *             grown    out  (gk, gj, words) grown samples: bit b is that of cell b, which is set where the cell belongs to
 *                           a chosen component; at the ends of a row, of its slice and of the grid that of the last cell
 *             grown_extents   out  (gk, gj) first word of the row with a bit set, and the one after the last
 *             gi gj gk, words   as above
 * Launch      as find_cell_runs
 * Guarantees  every extent is written, and every word of rows that have an active cell: in others no edge is crossed */
__kernel void mark_grown(
    __global const uint *restrict active_cells, __global const uint *restrict run_starts,
    __global const ushort2 *restrict run_extents, __global const uint *restrict row_offsets,
    __global const uint *restrict roots, __global const uint *restrict chosen,
    __global uint *restrict grown, __global ushort2 *restrict grown_extents,
    const uint gi, const uint gj, const uint gk, const uint words)
{
    const uint row = get_global_id(0);
    if (row >= gj * gk)
        return;
    uint cell_row = row;
    if (row >= (gk - 1) * gj)
        cell_row -= gj;
    if (cell_row % gj == gj - 1)
        cell_row -= 1;
    const ushort2 extent = run_extents[cell_row];
    if (extent.x >= extent.y) {
        grown_extents[row] = (ushort2)(0, 0);
        return;
    }
    __global uint *row_grown = grown + (size_t)row * words;
    for (uint w = 0; w < extent.x; ++w)
        row_grown[w] = 0;
    for (uint w = extent.y; w < words; ++w)
        row_grown[w] = 0;
    uint run = row_offsets[cell_row], keeps = 0; /* all ones where the run that goes on is chosen */
    uint begin = words, end = 0, last_cell = 0;
    for (uint w = extent.x; w < extent.y; ++w) {
        uint active = active_cells[(size_t)cell_row * words + w], bits = 0;
        for (uint starts = run_starts[(size_t)cell_row * words + w]; starts != 0; starts &= starts - 1) {
            const uint before = (1u << lowest_bit(starts)) - 1;
            bits |= active & before & keeps;
            active &= ~before;
            keeps = chosen[roots[run++]] ? ~0u : 0u;
        }
        bits |= active & keeps;
        if (w == (gi - 1) >> 5) /* the sample behind the last cell */
            bits |= (bits << 1 | last_cell) & 1u << (gi - 1 & 31);
        last_cell = bits >> 31;
        row_grown[w] = bits;
        begin = min(begin, bits != 0 ? w : words);
        end = bits != 0 ? w + 1 : end;
    }
    grown_extents[row] = (ushort2)((ushort)min(begin, end), (ushort)end);
}

/* Parameters  grown        in   (gk, gj, words)
 *             grown_extents  in   (gk, gj)
 *             counts       out  (gk, gj) cells of the row that are grown, or share a face with one that is
 *             gi gj gk, words   as above
 * Launch      as find_cell_runs
 * Guarantees  every count is written */
__kernel void count_visited(
    __global const uint *restrict grown, __global const ushort2 *restrict grown_extents, __global uint *restrict counts,
    const uint gi, const uint gj, const uint gk, const uint words)
{
    const uint row = get_global_id(0);
    if (row >= gj * gk)
        return;
    const uint j = row % gj, k = row / gj;
    counts[row] = 0;
    if (j + 1 >= gj || k + 1 >= gk)
        return;
    const uint row_a = j > 0 ? row - 1 : row, row_b = row + 1, row_c = k > 0 ? row - gj : row, row_d = row + gj;
    const ushort2 extent = grown_extents[row], extent_a = grown_extents[row_a], extent_b = grown_extents[row_b],
        extent_c = grown_extents[row_c], extent_d = grown_extents[row_d];
    /* Extents of rows without a bit are 0; such rows need not be written, so what lies there does not count. */
#define END(extent) (uint)extent.y
#define BEGIN(extent) (extent.y != 0 ? (uint)extent.x : words)
#define COUNTS(extent) (extent.y != 0 ? ~0u : 0u)
    const uint last = max(max(END(extent), max(END(extent_a), END(extent_b))), max(END(extent_c), END(extent_d)));
    if (last == 0)
        return;
    const uint first = min(
        min(BEGIN(extent), min(BEGIN(extent_a), BEGIN(extent_b))), min(BEGIN(extent_c), BEGIN(extent_d)));
    const uint own_counts = COUNTS(extent), counts_a = COUNTS(extent_a), counts_b = COUNTS(extent_b),
        counts_c = COUNTS(extent_c), counts_d = COUNTS(extent_d);
    const uint begin = first - (first != 0), end = min(last + 1, words);
    __global const uint *of_row = grown + (size_t)row * words;
    __global const uint *a = grown + (size_t)row_a * words, *b = grown + (size_t)row_b * words;
    __global const uint *c = grown + (size_t)row_c * words, *d = grown + (size_t)row_d * words;
    uint count = 0, before = 0, own = of_row[begin] & own_counts;
    for (uint w = begin; w < end; ++w) {
        const uint after = w + 1 < words ? of_row[w + 1] & own_counts : 0;
        const uint visited = own | own << 1 | before >> 31 | own >> 1 | after << 31 | (a[w] & counts_a)
            | (b[w] & counts_b) | (c[w] & counts_c) | (d[w] & counts_d);
        if (visited != 0)
            count += popcount(visited & (uint)samples_with_next(w, gi));
        before = own;
        own = after;
    }
    counts[row] = count;
#undef END
#undef BEGIN
#undef COUNTS
}
