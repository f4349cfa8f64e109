/* Clusters of free points by density (DBSCAN), on a grid whose cells are so small that all points of one are neighbours.
 *
 * Reference: Ester, Kriegel, Sander and Xu 1996, "A density-based algorithm for discovering clusters in large spatial
 * databases with noise"; cells as nodes: Gunawan 2013, "A faster algorithm for DBSCAN"; rounds of hooking as in
 * primitives/union_find.cl.  points/cell_links.h shows the cells around one.
 *
 * Words: a core cell has core points.  The label of a core cell is another cell of its cluster with a smaller number, or
 * itself, and then the cell is a root.
 *
 * Passes
 *   1. find_core_points           core points, and a label for each core cell: itself
 *   2. join_chunks, note_words    clusters within chunks of cells, an item each: nearest rows, then all others, where
 *                                 whole words of the mask that have one root need no look
 *   3. hook_cells                 roots of different chunks, in rounds; jump_labels of primitives/union_find.cl
 *   4. find_firsts, mark_firsts   the first core point of each root, in the order of the input; the bits of these points
 *                                 (then count_marked of points/grid.cl and scan.cl)
 *   5. number_cells, label_free_points
 *
 * count_pairs forecasts the work where it may be too much.
 *
 * Races.  join_chunks reads and writes labels of cells of its own chunk alone.  hook_cells reads labels that no item
 * writes, and writes by atomic_min() what none reads; all who write its flag write the same.  find_firsts and
 * mark_firsts write by atomic_min() and atomic_or() alone.  Of all others each item writes words of its own. */
#include "points/cell_links.h"

/* Parameters  x y z    in   (n + LANES - 1,) sorted coordinates in mm
 *             starts   in   (cells + 1,);  mask, ranks: in (nz, ny, words);  see points/grid.h
 *             core_x   out  (n + LANES - 1,) x of core points, NaN for others
 *             labels   out  (cells,) the cell itself where it has a core point, else NO_CELL
 *             firsts   out  (cells,) NO_CELL
 *             origin   corner of cell (0, 0, 0), 1 / edge;  bounds: see points/pair_distance.h
 *             nx ny nz words cells    of the grid
 *             min_samples    neighbours of a core point, itself included, at least 1
 *             reach_squared  square of the distance of neighbours in edges of a cell, not less than it is
 * Launch      global = cells rounded up by the host, any local
 * Assumes     all points of a cell are neighbours; neighbours lie at most REACH cells apart along each axis
 * Guarantees  every element is written but the last LANES - 1 of core_x */
__kernel void find_core_points(
    GRID_PARAMETERS, __global float *restrict core_x, __global uint *restrict labels, __global uint *restrict firsts,
    const uint min_samples, const float reach_squared)
{
    const uint cell = get_global_id(0);
    if (cell >= cells)
        return;
    const point_grid grid = { x, y, z, starts, mask, ranks, origin, bounds, nx, ny, nz, words };
    const uint begin = starts[cell], end = starts[cell + 1];
    firsts[cell] = NO_CELL;
    uint label = end - begin >= min_samples ? cell : NO_CELL;
    if (label == cell) {
        for (uint at = begin; at < end; ++at)
            core_x[at] = x[at];
        labels[cell] = label;
        return;
    }
    const int4 where = cell_of(&grid, begin);
    const int low = max(where.x - REACH, 0);
    for (uint at = begin; at < end; ++at) {
        const float3 point = (float3)(x[at], y[at], z[at]);
        const float2 t = place_in_cell(&grid, point, where);
        uint count = 0;
        for (int row = 0; row < ROWS && count < min_samples; ++row) {
            const int dy = row_y[row], dz = row_z[row];
            if (!is_row(&grid, where.y + dy, where.z + dz) || is_too_far(t, dy, dz, reach_squared))
                continue;
            const uint2 window = window_of(&grid, low, where.x, where.y + dy, where.z + dz);
            count += count_near(&grid, point, starts[window.x], starts[window.y], min_samples - count);
        }
        core_x[at] = count >= min_samples ? point.x : NAN;
        label = count >= min_samples ? cell : label;
    }
    labels[cell] = label;
}

/* Chunk of an item; on a CPU it is that of the work-group, and items but the first have none: NO_CELL. */
#if LANES == 8
static inline uint find_chunk(void) { return get_local_id(0) == 0 ? (uint)get_group_id(0) : NO_CELL; }
#else
static inline uint find_chunk(void) { return get_global_id(0); }
#endif

/* Root of a cell; the way there is halved. */
static inline uint find_root(__global uint *labels, uint cell)
{
    uint label = labels[cell];
    while (label != cell) {
        const uint next = labels[label];
        labels[cell] = next;
        cell = label;
        label = next;
    }
    return cell;
}

/* Whether words around `word` of a row have one root alone, that of `root`; `first` to `end` are cells of the chunk. */
static inline int have_root(
    __global const uint *roots, __global uint *labels, const point_grid *grid, const uint row, const int word,
    const uint root, const uint first, const uint end)
{
    for (int w = max(word - 1, 0); w <= min(word + 1, grid->words - 1); ++w) {
        const uint other = roots[row + (uint)w];
        if (other == NO_CELL || other == root)
            continue;
        if (other < first || other >= end || find_root(labels, other) != find_root(labels, root))
            return 0;
    }
    return 1;
}

/* Parameters  core_x     in      (n + LANES - 1,) as found
 *             roots      in      (nz, ny, words) as note_words left them; not read for the nearest rows
 *             labels     in/out  (cells,) flat within each chunk; then with the links of these rows
 *             per_chunk  cells of a chunk
 *             first_row end_row    forward rows to search; roots are read from NEAR_ROWS on
 *             others as in find_core_points
 * Launch      one item a chunk, the first of its work-group with LANES 8
 * Guarantees  the label of a cell is the least of its chunk that it is linked with by the rows searched so far */
__kernel void join_chunks(
    GRID_PARAMETERS, __global const float *restrict core_x, __global const uint *restrict roots,
    __global uint *labels, const uint per_chunk, const int first_row, const int end_row)
{
    const uint chunk = find_chunk();
    if (chunk > (cells - 1) / per_chunk)
        return;
    const point_grid grid = { x, y, z, starts, mask, ranks, origin, bounds, nx, ny, nz, words };
    const uint first = chunk * per_chunk, end = first + min(per_chunk, cells - first);
    uint last_word = NO_CELL, needed = ~0u;
    for (uint cell = first; cell < end; ++cell) {
        if (labels[cell] == NO_CELL)
            continue;
        const int4 where = cell_of(&grid, starts[cell]);
        if (first_row >= NEAR_ROWS) {
            const int word_x = where.x >> 5;
            const uint word = grid_row(where.y, where.z, ny, words) + (uint)word_x;
            if (word != last_word) {
                last_word = word;
                const uint root = roots[word];
                needed = 0;
                for (int row = first_row; row < end_row; ++row) {
                    const int ry = where.y + forward_y[row], rz = where.z + forward_z[row];
                    if (is_row(&grid, ry, rz)
                        && (root == SEVERAL_ROOTS
                            || !have_root(roots, labels, &grid, grid_row(ry, rz, ny, words), word_x, root, first, end)))
                        needed |= 1u << row;
                }
            }
            if (needed == 0)
                continue;
        }
        uint root = find_root(labels, cell);
        for (int row = first_row; row < end_row; ++row) {
            const int ry = where.y + forward_y[row], rz = where.z + forward_z[row];
            if (!(needed >> row & 1) || !is_row(&grid, ry, rz))
                continue;
            const int low = row == 0 ? where.x : max(where.x - REACH, 0);
            const uint2 window = window_of(&grid, low, where.x, ry, rz);
            const uint last = min(window.y, end);
            uint joined = NO_CELL; /* a label of this root: in rows that are searched first it is that of a whole run */
            for (uint other = row == 0 ? cell + 1 : window.x; other < last; ++other) {
                const uint label = labels[other];
                if (label == NO_CELL || label == joined)
                    continue;
                const uint other_root = find_root(labels, label);
                if (other_root != root) {
                    if (!are_linked(&grid, core_x, cell, other))
                        continue;
                    labels[max(root, other_root)] = min(root, other_root);
                    root = min(root, other_root);
                }
                joined = label;
            }
        }
    }
    for (uint cell = first; cell < end; ++cell)
        if (labels[cell] != NO_CELL)
            labels[cell] = labels[labels[cell]];
}

/* Parameters  mask ranks    in   (total,)
 *             labels        in   (cells,) all of them roots
 *             roots         out  (total,) the root of all core cells of each word: SEVERAL_ROOTS, or NO_CELL for none
 *             total         words
 * Launch      global = total rounded up by the host, any local
 * Guarantees  every root is written */
__kernel void note_words(
    __global const uint *restrict mask, __global const uint *restrict ranks, __global const uint *restrict labels,
    __global uint *restrict roots, const uint total)
{
    const uint word = get_global_id(0);
    if (word >= total)
        return;
    const uint begin = ranks[word], end = begin + popcount(mask[word]);
    uint root = NO_CELL;
    for (uint cell = begin; cell < end && root != SEVERAL_ROOTS; ++cell) {
        const uint label = labels[cell];
        if (label != NO_CELL)
            root = root == NO_CELL || root == label ? label : SEVERAL_ROOTS;
    }
    roots[word] = root;
}

/* Whether a word has core cells with another root than `root`. */
static inline int has_others(__global const uint *labels, const uint noted, const uint root)
{
    return noted != NO_CELL && (noted == SEVERAL_ROOTS || labels[noted] != root);
}

/* Number of cells with points in all layers up to z. */
static inline uint cells_up_to(const point_grid *grid, const uint cells, const int z)
{
    return z + 1 < grid->nz ? grid->ranks[grid_row(0, z + 1, grid->ny, grid->words)] : cells;
}

/* Parameters  core_x       in      (n + LANES - 1,)
 *             roots        in      (nz, ny, words) as note_words left them, for these labels or earlier ones
 *             labels       in      (cells,) all of them roots
 *             hooked       in/out  (cells,) roots as labels; then the least root of another chunk that each is linked
 *                                  with, where that is less
 *             flags        out     [1]: pass_number where a root was hooked, else as it was
 *             per_chunk    cells of a chunk, a multiple of per_item
 *             per_item     neighbouring cells of an item
 *             pass_number  counts from 1
 *             others as in find_core_points
 * Launch      global = cells / per_item rounded up by the host, any local
 * Guarantees  without the flag all linked cells have one root */
__kernel void hook_cells(
    GRID_PARAMETERS, __global const float *restrict core_x, __global const uint *restrict roots,
    __global const uint *restrict labels, __global uint *hooked, __global uint *flags, const uint per_chunk,
    const uint per_item, const uint pass_number)
{
    const uint item = get_global_id(0);
    if (item > (cells - 1) / per_item)
        return;
    const point_grid grid = { x, y, z, starts, mask, ranks, origin, bounds, nx, ny, nz, words };
    const uint first = item * per_item, end = first + min(per_item, cells - first);
    const uint chunk = first / per_chunk;
    const uint beyond = cells - chunk * per_chunk > per_chunk ? (chunk + 1) * per_chunk : cells;
    const int layer = cell_of(&grid, starts[end - 1]).z;
    const uint end_0 = cells_up_to(&grid, cells, layer), end_1 = cells_up_to(&grid, cells, layer + 1);
    if (cells_up_to(&grid, cells, layer + REACH) <= beyond)
        return;
    uint last_root = NO_CELL, last_other = NO_CELL;
    for (uint cell = first; cell < end; ++cell) {
        const uint root = labels[cell];
        if (root == NO_CELL)
            continue;
        const int4 where = cell_of(&grid, starts[cell]);
        for (int row = 0; row < FORWARD_ROWS; ++row) {
            const int ry = where.y + forward_y[row], rz = where.z + forward_z[row];
            if (!is_row(&grid, ry, rz) || (rz < layer + REACH && (rz <= layer ? end_0 : end_1) <= beyond))
                continue;
            const int low = row == 0 ? where.x : max(where.x - REACH, 0);
            const uint from = grid_row(ry, rz, ny, words);
            if (!has_others(labels, roots[from + ((uint)low >> 5)], root)
                && !has_others(labels, roots[from + ((uint)min(where.x + REACH, nx - 1) >> 5)], root))
                continue;
            const uint2 window = window_of(&grid, low, where.x, ry, rz);
            for (uint other = max(window.x, beyond); other < window.y; ++other) {
                const uint other_root = labels[other];
                if (other_root == NO_CELL || other_root == root || (root == last_root && other_root == last_other)
                    || !are_linked(&grid, core_x, cell, other))
                    continue;
                atomic_min(hooked + max(root, other_root), min(root, other_root));
                flags[1] = pass_number;
                last_root = root;
                last_other = other_root;
            }
        }
    }
}

/* Parameters  core_x    in      (n + LANES - 1,)
 *             starts    in      (cells + 1,)
 *             order     in      (n,) number of the point at each place
 *             labels    in      (cells,) all of them roots
 *             firsts    in/out  (cells,) NO_CELL; then for roots the least number of a core point of their cluster
 *             per_item  neighbouring cells of an item
 * Launch      global = cells / per_item rounded up by the host, any local */
__kernel void find_firsts(
    __global const float *restrict core_x, __global const uint *restrict starts, __global const uint *restrict order,
    __global const uint *restrict labels, __global uint *firsts, const uint cells, const uint per_item)
{
    const uint item = get_global_id(0);
    if (item > (cells - 1) / per_item)
        return;
    const uint begin = item * per_item, end = begin + min(per_item, cells - begin);
    uint root = NO_CELL, least = NO_CELL;
    for (uint cell = begin; cell < end; ++cell) {
        if (labels[cell] == NO_CELL)
            continue;
        if (labels[cell] != root && root != NO_CELL) {
            atomic_min(firsts + root, least);
            least = NO_CELL;
        }
        root = labels[cell];
        uint at = starts[cell];
        while (isnan(core_x[at]))
            ++at;
        least = min(least, order[at]);
    }
    if (root != NO_CELL)
        atomic_min(firsts + root, least);
}

/* Parameters  labels  in      (cells,) all of them roots
 *             firsts  in      (cells,) of roots the number of their first core point
 *             marks   in/out  (n / 32,) zeros; then a bit for each of these points
 *             cells   with points
 * Launch      global = cells rounded up by the host, any local */
__kernel void mark_firsts(
    __global const uint *restrict labels, __global const uint *restrict firsts, __global uint *marks, const uint cells)
{
    const uint cell = get_global_id(0);
    if (cell < cells && labels[cell] == cell)
        atomic_or(marks + (firsts[cell] >> 5), 1u << (firsts[cell] & 31));
}

/* Parameters  labels   in   (cells,) all of them roots
 *             firsts   in   (cells,)
 *             marks    in   (n / 32,) bits of first core points
 *             before   in   (n / 32,) exclusive scan of the bits
 *             numbers  out  (cells,) number of the cluster of each core cell, NO_CELL for others
 *             cells    with points
 * Launch      global = cells rounded up by the host, any local
 * Guarantees  every number is written; clusters are numbered in the order of their first core points */
__kernel void number_cells(
    __global const uint *restrict labels, __global const uint *restrict firsts, __global const uint *restrict marks,
    __global const uint *restrict before, __global uint *restrict numbers, const uint cells)
{
    const uint cell = get_global_id(0);
    if (cell >= cells)
        return;
    const uint root = labels[cell];
    uint number = NO_CELL;
    if (root != NO_CELL)
        number = grid_cells_before(marks, before, firsts[root] >> 5, (int)(firsts[root] & 31));
    numbers[cell] = number;
}

/* Parameters  core_x    in   (n + LANES - 1,)
 *             order     in   (n,) number of the point at each place
 *             numbers   in   (cells,) number of the cluster of each core cell, NO_CELL for others
 *             clusters  out  (n,) in the order of the input: own cluster of core points; of others the least of their
 *                            core neighbours, -1 without any
 *             cores     out  (n,) in the order of the input: 1 for core points
 *             others as in find_core_points
 * Launch      global = cells rounded up by the host, any local
 * Guarantees  every element is written */
__kernel void label_free_points(
    GRID_PARAMETERS, __global const float *restrict core_x, __global const uint *restrict order,
    __global const uint *restrict numbers, __global int *restrict clusters, __global uchar *restrict cores,
    const float reach_squared)
{
    const uint cell = get_global_id(0);
    if (cell >= cells)
        return;
    const point_grid grid = { x, y, z, starts, mask, ranks, origin, bounds, nx, ny, nz, words };
    const uint own = numbers[cell], end = starts[cell + 1];
    const int4 where = cell_of(&grid, starts[cell]);
    const int low = max(where.x - REACH, 0);
    for (uint at = starts[cell]; at < end; ++at) {
        const int is_core = !isnan(core_x[at]);
        const float3 point = (float3)(x[at], y[at], z[at]);
        const float2 t = place_in_cell(&grid, point, where);
        uint least = own;
        for (int row = 0; row < ROWS && !is_core && least > 0; ++row) {
            const int dy = row_y[row], dz = row_z[row];
            if (!is_row(&grid, where.y + dy, where.z + dz) || is_too_far(t, dy, dz, reach_squared))
                continue;
            const uint2 window = window_of(&grid, low, where.x, where.y + dy, where.z + dz);
            for (uint other = window.x; other < window.y; ++other)
                if (numbers[other] < least && has_near_core(&grid, core_x, point, starts[other], starts[other + 1]))
                    least = numbers[other];
        }
        clusters[order[at]] = (int)least;
        cores[order[at]] = (uchar)is_core;
    }
}

/* Parameters  pairs        out  (cells,) candidate pairs of points of each cell, at most
 *             min_samples  as in find_core_points
 *             others as in find_core_points
 * Launch      global = cells rounded up by the host, any local
 * Guarantees  every element is written */
__kernel void count_pairs(GRID_PARAMETERS, __global float *restrict pairs, const uint min_samples)
{
    const uint cell = get_global_id(0);
    if (cell >= cells)
        return;
    const point_grid grid = { x, y, z, starts, mask, ranks, origin, bounds, nx, ny, nz, words };
    const int4 where = cell_of(&grid, starts[cell]);
    const int low = max(where.x - REACH, 0);
    const uint own = starts[cell + 1] - starts[cell];
    float around = 0.0f, after = 0.0f;
    for (int row = 0; row < ROWS; ++row) {
        const int ry = where.y + row_y[row], rz = where.z + row_z[row];
        if (!is_row(&grid, ry, rz))
            continue;
        const uint2 window = window_of(&grid, low, where.x, ry, rz);
        around += (float)(starts[window.y] - starts[window.x]);
        if (window.y > cell + 1)
            after += (float)(starts[window.y] - starts[max(window.x, cell + 1)]);
    }
    pairs[cell] = (float)own * (after + (own < min_samples ? around : 0.0f));
}
