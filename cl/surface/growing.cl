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
 *   2. begin_cell_runs     each run by itself, and its number of cells
 *   3. join_cell_runs      runs of neighbouring rows with a mixed face between them
 *   4. find_run_roots     the smallest run of each component
 *      (numbering of the components: cl/primitives/union_find.cl; the host chooses some)
 *   5. seed_cell_runs      where seeds are a mask: the runs whose cells have a corner in it
 *   6. mark_grown     bits of the cells of chosen components
 *   7. start_rows     in open volumes: whether the kept mask is set at the begin of each row
 *   8. keep_edges     the kept mask: the inside mask that has the crossed edges of grown cells, and no others
 *   9. count_visited  grown cells and their neighbours
 *
 * The kept mask.  All cells around a crossed edge are active and belong to one component, so an edge is grown or it is
 * not, and on the border of each face an even number of grown edges is crossed.  Hence a mask whose crossed edges are
 * the grown ones exists: along each row it changes where a grown edge is crossed.  A cell has the case of the inside
 * mask in the kept mask, or the inverted one; the case is therefore read from the inside mask (cells.cl, -D GROWN).
 *
 * Races.  join_cell_runs is the only pass where items read what others write in the same launch.  A parent is never above
 * its run and only ever falls: at roots by atomic_cmpxchg(), from the root itself to a smaller run of the same
 * component; at other runs by atomic_min(), to the parent's parent.  A parent that an item reads too early was a parent a moment ago, so following
 * it leads to the same component, and the swap of one that is no root any more fails and says the new one.  No item
 * waits for another.  A root is the smallest run of its component whatever the order: the outcome is the same on every
 * device. */
#include "include/mask_rows.h"
#include "surface/cell_runs.h"

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

/* Parameters  active_cells, run_starts, run_extents   in   of find_cell_runs
 *             row_offsets  in   (gk, gj) runs of all rows before each
 *             parents      out  (runs,) each run's own number
 *             run_cells    out  (runs,) its number of cells
 *             gj gk, words   as above
 * Launch      as find_cell_runs
 * Guarantees  every run is written once */
__kernel void begin_cell_runs(
    __global const uint *restrict active_cells, __global const uint *restrict run_starts,
    __global const ushort2 *restrict run_extents, __global const uint *restrict row_offsets,
    __global uint *restrict parents, __global uint *restrict run_cells,
    const uint gj, const uint gk, const uint words)
{
    const uint row = get_global_id(0);
    if (row >= gj * gk)
        return;
    const ushort2 extent = run_extents[row];
    uint run = row_offsets[row], cells = 0;
    int running = 0; /* a run has begun: it is `run` - 1 */
    for (uint w = extent.x; w < extent.y; ++w) {
        uint active = active_cells[(size_t)row * words + w];
        for (uint starts = run_starts[(size_t)row * words + w]; starts != 0; starts &= starts - 1) {
            const uint before = (1u << lowest_bit(starts)) - 1;
            if (running)
                run_cells[run - 1] = cells + popcount(active & before);
            active &= ~before;
            cells = 0;
            running = 1;
            parents[run] = run;
            ++run;
        }
        cells += popcount(active);
    }
    if (running)
        run_cells[run - 1] = cells;
}

/* Join the runs of a row of cells with those of the next one, row `other`, in word w.  `mixed` are the
 * faces, `joined` those whose cells others join; `mixed_before` says whether the last face of the word before is mixed,
 * and is then told that of this word. */
static inline void join_word(
    volatile __global uint *parents, __global const uint *run_starts, __global const ushort *word_runs,
    __global const uint *row_offsets, uint row, uint other, uint w, uint words, uint mixed, uint joined,
    uint *mixed_before)
{
    if (mixed == 0) {
        *mixed_before = 0;
        return;
    }
    const size_t at = (size_t)row * words + w, other_at = (size_t)other * words + w;
    const uint starts = run_starts[at], other_starts = run_starts[other_at];
    /* Where both runs go on from a cell whose face is mixed too, they have been joined there. */
    uint joins = mixed & ~joined & ~((mixed << 1 | *mixed_before) & ~starts & ~other_starts);
    *mixed_before = mixed >> 31;
    for (; joins != 0; joins &= joins - 1) {
        const uint upto = (joins & -joins) | ((joins & -joins) - 1);
        unite(parents, row_offsets[row] + word_runs[at] + popcount(starts & upto) - 1,
            row_offsets[other] + word_runs[other_at] + popcount(other_starts & upto) - 1);
    }
}

/* Parameters  mask, run_starts, word_runs, run_extents   in   of find_cell_runs
 *             row_offsets  in      (gk, gj)
 *             parents      in/out  (runs,) begun; then each run has a parent of its component that is not above it
 *             gi gj gk, words   as above
 * Launch      as find_cell_runs
 * Guarantees  two runs lead to one root where mixed faces join them; the root is the smallest run */
__kernel void join_cell_runs(
    __global const uint *restrict mask, __global const uint *restrict run_starts,
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
    __global const uint *y1z0 = mask + (size_t)(row + 1) * words;
    __global const uint *y0z1 = mask + (size_t)(row + gj) * words;
    __global const uint *y1z1 = y0z1 + words;
    uint mixed_y_before = 0, mixed_z_before = 0;
    cell_rows rows = {0, y1z0[extent.x], y0z1[extent.x], y1z1[extent.x]};
    for (uint w = extent.x; w < extent.y; ++w) {
        const uint next = w + 1 < words ? w + 1 : w;
        const cell_rows next_rows = {0, y1z0[next], y0z1[next], y1z1[next]};
        rows.y1z0 |= next_rows.y1z0 << 32;
        rows.y0z1 |= next_rows.y0z1 << 32;
        rows.y1z1 |= next_rows.y1z1 << 32;
        if (w >= next_y.x && w < next_y.y)
            join_word(parents, run_starts, word_runs, row_offsets, row, row + 1, w, words,
                find_mixed_faces(rows.y1z0, rows.y1z1, w, gi), 0, &mixed_y_before);
        if (w >= next_z.x && w < next_z.y) {
            const uint mixed = find_mixed_faces(rows.y0z1, rows.y1z1, w, gi);
            uint joined = 0;
            if (j > 0 && mixed != 0) {
                /* Round the edge that four cells share: by the row before, both cells are joined to its own already. */
                const ulong own = load_window(mask, row, w, words);
                const ulong before = load_window(mask, row + gj - 1, w, words);
                const ulong beyond = load_window(mask, row + 2 * gj, w, words);
                joined = find_mixed_faces(before, rows.y0z1, w, gi) & find_mixed_faces(own, rows.y0z1, w, gi)
                    & find_mixed_faces(rows.y0z1, beyond, w, gi);
            }
            join_word(parents, run_starts, word_runs, row_offsets, row, row + gj, w, words, mixed, joined,
                &mixed_z_before);
        }
        rows = next_rows;
    }
}

/* Parameters  parents  in   (runs,) joined
 *             roots    out  (runs,) the smallest run of each run's component
 *             runs
 * Launch      global = runs rounded up by the host, any local
 * Guarantees  every root is written */
__kernel void find_run_roots(__global const uint *restrict parents, __global uint *restrict roots, const uint runs)
{
    const uint run = get_global_id(0);
    if (run < runs)
        roots[run] = find_root(parents, run);
}

/* Parameters  mask, run_starts, word_runs, run_extents, row_offsets   in   as above
 *             seeds        in   (nk, nj, voxel_words) voxels that are seeds, without a border
 *             seeded       out  (runs,) 1 where a cell of the run has an enclosed corner that is a seed, else 0
 *             enclosed_set   1 where set bits of the mask are enclosed by the surface, 0 where the others are
 *             border       layers of samples around the volume, 0 or 1
 *             voxel_words  words of a row of `seeds`
 *             gi gj gk, words   as above
 * Launch      as find_cell_runs
 * Guarantees  every run is written, by the item of its row */
__kernel void seed_cell_runs(
    __global const uint *restrict mask, __global const uint *restrict run_starts,
    __global const ushort *restrict word_runs, __global const ushort2 *restrict run_extents,
    __global const uint *restrict row_offsets, __global const uint *restrict seeds, __global uint *restrict seeded,
    const int enclosed_set, const uint border, const uint voxel_words,
    const uint gi, const uint gj, const uint gk, const uint words)
{
    const uint row = get_global_id(0);
    if (row >= gj * gk)
        return;
    const uint j = row % gj, k = row / gj;
    const ushort2 extent = run_extents[row];
    uint run = row_offsets[row], found = 0;
    int running = 0;
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
            if (running)
                seeded[run - 1] = found | ((seeds_here & before) != 0);
            seeds_here &= ~before;
            found = 0;
            running = 1;
            ++run;
        }
        found |= seeds_here != 0;
    }
    if (running)
        seeded[run - 1] = found;
}

/* Parameters  active_cells, run_starts, run_extents, row_offsets   in   as above
 *             numbers  in   (runs,) component of each run
 *             chosen   in   (components,) 1 for chosen ones, else 0
 *             grown    out  (gk, gj, words) bit b: cell b of the word belongs to a chosen component
 *             grown_extents   out  (gk, gj) first word of the row with a grown cell, and the one after the last
 *             gj gk, words   as above
 * Launch      as find_cell_runs
 * Guarantees  every word is written */
__kernel void mark_grown(
    __global const uint *restrict active_cells, __global const uint *restrict run_starts,
    __global const ushort2 *restrict run_extents, __global const uint *restrict row_offsets,
    __global const int *restrict numbers, __global const uchar *restrict chosen, __global uint *restrict grown,
    __global ushort2 *restrict grown_extents,
    const uint gj, const uint gk, const uint words)
{
    const uint row = get_global_id(0);
    if (row >= gj * gk)
        return;
    const ushort2 extent = run_extents[row];
    __global uint *row_grown = grown + (size_t)row * words;
    for (uint w = 0; w < extent.x; ++w)
        row_grown[w] = 0;
    for (uint w = extent.y; w < words; ++w)
        row_grown[w] = 0;
    uint run = row_offsets[row], keeps = 0; /* all ones where the run that goes on is chosen */
    uint begin = words, end = 0;
    for (uint w = extent.x; w < extent.y; ++w) {
        uint active = active_cells[(size_t)row * words + w], bits = 0;
        for (uint starts = run_starts[(size_t)row * words + w]; starts != 0; starts &= starts - 1) {
            const uint before = (1u << lowest_bit(starts)) - 1;
            bits |= active & before & keeps;
            active &= ~before;
            keeps = chosen[numbers[run++]] ? ~0u : 0u;
        }
        bits |= active & keeps;
        row_grown[w] = bits;
        begin = min(begin, bits != 0 ? w : words);
        end = bits != 0 ? w + 1 : end;
    }
    grown_extents[row] = (ushort2)((ushort)min(begin, end), (ushort)end);
}

/* The row of cells that has a crossed edge along i from row (j, k) of samples, in the bits of the whole grid. */
static inline size_t cell_row_of(uint j, uint k, uint gj, uint whole_gk)
{
    return (size_t)min(k, whole_gk - 2) * gj + min(j, gj - 2);
}

/* Parameters  mask    in   (gk, gj, words)
 *             grown   in   (gk, gj, words)
 *             starts  out  (gk, gj) 1 where the kept mask is set at the first sample of a row, else 0
 *             gj gk, words   as above
 * Launch      global = gk rounded up by the host, any local
 * Guarantees  every entry is written; that of row (0, 0) is 0 */
__kernel void start_rows(
    __global const uint *restrict mask, __global const uint *restrict grown, __global uint *restrict starts,
    const uint gj, const uint gk, const uint words)
{
    const uint k = get_global_id(0);
    if (k >= gk)
        return;
#define FIRST(bits, j, k) (bits[((size_t)(k) * gj + (j)) * words] & 1)
    uint set = 0;
    for (uint before = 0; before < k; ++before)
        set ^= (FIRST(mask, 0, before) ^ FIRST(mask, 0, before + 1)) & FIRST(grown, 0, before);
    const uint cells = min(k, gk - 2);
    starts[(size_t)k * gj] = set;
    for (uint j = 1; j < gj; ++j) {
        set ^= (FIRST(mask, j - 1, k) ^ FIRST(mask, j, k)) & FIRST(grown, j - 1, cells);
        starts[(size_t)k * gj + j] = set;
    }
#undef FIRST
}

/* Parameters  mask          in   (gk, gj, words) inside mask of a slab
 *             grown, grown_extents   in   (whole_gk, gj, words) and (whole_gk, gj) of mark_grown
 *             starts        in   (whole_gk, gj) of start_rows; unused where rows_start is 0
 *             kept          out  (gk, gj, words) kept mask of the slab
 *             kept_extents  out  (gk, gj) its extents
 *             rows_start    1 where `starts` says with what rows begin, 0 where they begin outside
 *             gi gj gk, words   of the slab;  first  slice of the grid that it begins with;  whole_gk  of the grid
 * Launch      global = gj * gk rounded up by the host, any local
 * Guarantees  every word and extent is written; bits beyond the row are 0 */
__kernel void keep_edges(
    __global const uint *restrict mask, __global const uint *restrict grown,
    __global const ushort2 *restrict grown_extents, __global const uint *restrict starts,
    __global uint *restrict kept, __global ushort2 *restrict kept_extents, const int rows_start,
    const uint gi, const uint gj, const uint gk, const uint words, const uint first, const uint whole_gk)
{
    const uint row = get_global_id(0);
    if (row >= gj * gk)
        return;
    const uint j = row % gj, k = row / gj + first;
    const size_t cell_row = cell_row_of(j, k, gj, whole_gk);
    __global const uint *row_grown = grown + cell_row * words;
    __global uint *row_kept = kept + (size_t)row * words;
    const ushort2 extent = grown_extents[cell_row];
    uint set = rows_start ? 0u - starts[(size_t)k * gj + j] : 0u; /* all ones, or 0 */
    uint begin = words, end = 0;
    for (uint w = 0; w < words; ++w) {
        uint bits = set;
        if (w >= extent.x && w < extent.y) {
            const ulong own = load_window(mask, row, w, words);
            uint flips = (uint)((own ^ own >> 1) & samples_with_next(w, gi)) & row_grown[w];
            if (flips != 0) {
                flips ^= flips << 1;
                flips ^= flips << 2;
                flips ^= flips << 4;
                flips ^= flips << 8;
                flips ^= flips << 16; /* bit b: the number of flips up to b is odd */
                bits ^= flips << 1;
                set ^= 0u - (flips >> 31);
            }
        }
        bits &= (uint)low_bits(min(32u, gi - min(32 * w, gi)));
        row_kept[w] = bits;
        begin = min(begin, bits != 0 ? w : words);
        end = bits != 0 ? w + 1 : end;
    }
    kept_extents[row] = (ushort2)((ushort)min(begin, end), (ushort)end);
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
    uint count = 0;
    if (j + 1 < gj && k + 1 < gk) {
        const uint around[5] = {row, j > 0 ? row - 1 : row, row + 1, k > 0 ? row - gj : row, row + gj};
        uint begin = words, end = 0;
        for (uint n = 0; n < 5; ++n) {
            const ushort2 extent = grown_extents[around[n]];
            if (extent.x < extent.y) {
                begin = min(begin, (uint)extent.x);
                end = max(end, (uint)extent.y);
            }
        }
        begin -= begin != 0;
        end = min(end + 1, words);
        for (uint w = begin; w < end; ++w) {
            const uint own = grown[(size_t)row * words + w];
            const uint before = w > 0 ? grown[(size_t)row * words + w - 1] >> 31 : 0;
            const uint after = w + 1 < words ? grown[(size_t)row * words + w + 1] << 31 : 0;
            uint visited = own | own << 1 | before | own >> 1 | after;
            for (uint n = 1; n < 5; ++n)
                visited |= grown[(size_t)around[n] * words + w];
            count += popcount(visited & (uint)samples_with_next(w, gi));
        }
    }
    counts[row] = count;
}
