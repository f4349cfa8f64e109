/* Runs of set voxels along the rows of a bit mask: listed, joined with their neighbours, and written to a mask again.
 *
 * References: runs as the nodes of connected components are old (Rosenfeld and Pfaltz 1966); the joining of parts is our
 * own, that of pairs is union_find.cl.
 *
 * Rows are numbered (j, k) -> k nj + j.  A stencil is a list of rows (dj, dk, lowest di, highest di); `tables` says
 * which part of the list is that of slice k.  Of a stencil the rows behind the voxel's own are enough.
 *
 *      row         ..######....##.     a run goes across the words of its row
 *      runs          2    7    12 13   first and last column
 *
 * Passes
 *   1. count_row_runs    of each row; then scan.cl
 *   2. list_row_runs
 *   3. join_runs     parts of the rows, each by one work-item: union-find without a second writer
 *   4. count_links, list_links   pairs of runs in different parts, joined by union_find.cl
 *   5. mark_border_runs, mark_voxel_runs   components that reach the border, or that hold a voxel of a list
 *   6. write_runs    those of marked components, or of the others
 *
 * Races.  Each item of 1 to 4 and 6 writes words of its own alone: a row, a part, a place in a list.  In 5 several items
 * may write the same mark, the same value each. */

/* The root of a run of this item's own part; halves the way to it.
 *
 * Arguments are not `restrict`: inlined, it becomes an instruction that Oclgrind 21.10 does not know. */
static inline uint find_root(__global uint *labels, uint run)
{
    uint label = labels[run];
    while (label != run) {
        const uint next = labels[label];
        labels[run] = next;
        run = next;
        label = labels[run];
    }
    return run;
}

/* Pairs of a part's runs with those of later parts; writes them if there is a place for them, and returns how many. */
static inline uint find_links(
    __global const ushort2 *runs, __global const uint *row_counts,
    __global const int4 *stencil, __global const int2 *tables, __global const uint *labels,
    __global uint *links, const int nj, const int nk, const uint row, const uint end_row)
{
    const uint own_begin = row_counts[row], own_end = row_counts[row + 1];
    if (own_begin == own_end)
        return 0;
    const int j = row % nj, k = row / nj;
    const int2 table = tables[k];
    uint count = 0, last_a = 0, last_b = 0;
    for (int which = table.x; which < table.y; ++which) {
        const int4 near = stencil[which];
        const uint other = row + near.y * nj + near.x;
        if (j + near.x < 0 || j + near.x >= nj || k + near.y >= nk || other < end_row)
            continue;
        uint first = row_counts[other];
        const uint end = row_counts[other + 1];
        for (uint own = own_begin; own < own_end && first < end; ++own) {
            const int begin = (int)runs[own].x + near.z, last = (int)runs[own].y + near.w;
            while (first < end && (int)runs[first].y < begin)
                ++first;
            for (uint next = first; next < end && (int)runs[next].x <= last; ++next) {
                const uint a = labels[own], b = labels[next];
                if (a == last_a && b == last_b)
                    continue;
                last_a = a;
                last_b = b;
                if (links != 0)
                    vstore3((uint3)(a, b, b), count, links);
                ++count;
            }
        }
    }
    return count;
}

/* Parameters  mask         in   (rows, words)
 *             bits         in   (rows, words) voxels of the mask, those whose runs are counted
 *             row_extents  in   (rows) of the mask
 *             row_counts   out  (2, rows + 1) runs of `bits` along i, and voxels of the mask; 0 behind the last row
 *             rows, words
 *             lone         1 where eps is below the step along i: each bit is a run of its own
 * Launch      global = rows + 1 rounded up by the host, any local
 * Guarantees  every count is written */
__kernel void count_row_runs(
    __global const uint *restrict mask, __global const uint *restrict bits,
    __global const ushort2 *restrict row_extents, __global uint *restrict row_counts, const uint rows, const int words,
    const int lone)
{
    const uint row = get_global_id(0);
    if (row > rows)
        return;
    const ushort2 extent = row < rows ? row_extents[row] : (ushort2)(0, 0);
    const size_t at = (size_t)row * words;
    uint runs = 0, points = 0, before = 0;
    for (int w = extent.x; w < extent.y; ++w) {
        const uint own = bits[at + w];
        runs += popcount(lone ? own : own & ~(own << 1 | before));
        points += popcount(mask[at + w]);
        before = own >> 31;
    }
    row_counts[row] = runs;
    row_counts[rows + 1 + row] = points;
}

/* Parameters  bits         in   (rows, words)
 *             row_extents  in   (rows)
 *             row_counts   in   (rows + 1) number of runs in all rows before
 *             runs         out  (count) first and last column of each run, row by row
 *             rows, words, lone  as count_row_runs
 * Launch      global = rows rounded up by the host, any local
 * Guarantees  every run is written */
__kernel void list_row_runs(
    __global const uint *restrict bits, __global const ushort2 *restrict row_extents,
    __global const uint *restrict row_counts, __global ushort2 *restrict runs, const uint rows, const int words,
    const int lone)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    const ushort2 extent = row_extents[row];
    const size_t at = (size_t)row * words;
    uint place = row_counts[row];
    int begin = -1;
    for (int w = extent.x; w < extent.y; ++w) {
        const uint own = bits[at + w];
        const int column = 32 * w;
        if (lone) {
            for (uint rest = own; rest != 0; rest &= rest - 1)
                runs[place++] = (ushort2)((ushort)(column + popcount((rest & -rest) - 1)));
            continue;
        }
        /* Bits that differ from the one before: runs begin and end there, in turn. */
        uint changes = own ^ own << 1 ^ (uint)(begin >= 0);
        while (changes != 0) {
            const int bit = popcount((changes & -changes) - 1);
            if (begin < 0)
                begin = column + bit;
            else {
                runs[place++] = (ushort2)((ushort)begin, (ushort)(column + bit - 1));
                begin = -1;
            }
            changes &= changes - 1;
        }
    }
    if (begin >= 0)
        runs[place] = (ushort2)((ushort)begin, (ushort)(32 * extent.y - 1));
}

/* Parameters  runs        in       (count)
 *             row_counts  in       (rows + 1) first run of each row, and `count`
 *             stencil     in       (m) rows of the forward stencils
 *             tables      in       (nk)
 *             labels      out      (count) the smallest run of the part that a run is joined with
 *             roots       out      (count) of roots their own number
 *             nj, nk      rows a slice, and slices
 *             part_rows   rows a part
 *             spread      work-items for one part, of which the first does all
 * Launch      global = ceil(rows / part_rows) spread rounded up by the host, any local
 * Guarantees  every label is a root; runs of different parts have different labels */
__kernel void join_runs(
    __global const ushort2 *restrict runs, __global const uint *restrict row_counts,
    __global const int4 *restrict stencil, __global const int2 *restrict tables, __global uint *labels,
    __global uint *restrict roots, const int nj, const int nk, const uint part_rows, const uint spread)
{
    const uint item = get_global_id(0), rows = nj * nk;
    const uint part = item / spread;
    if (item % spread != 0 || part > (rows - 1) / part_rows)
        return;
    const uint first_row = part * part_rows, end_row = min(first_row + part_rows, rows);
    const uint first_run = row_counts[first_row], end_run = row_counts[end_row];
    for (uint run = first_run; run < end_run; ++run)
        labels[run] = run;
    for (uint row = first_row; row < end_row; ++row) {
        const uint own_begin = row_counts[row], own_end = row_counts[row + 1];
        if (own_begin == own_end)
            continue;
        const int j = row % nj, k = row / nj;
        const int2 table = tables[k];
        for (int which = table.x; which < table.y; ++which) {
            const int4 near = stencil[which];
            const uint other = row + near.y * nj + near.x;
            if (j + near.x < 0 || j + near.x >= nj || k + near.y >= nk || other >= end_row)
                continue;
            uint first = row_counts[other];
            const uint end = row_counts[other + 1];
            for (uint own = own_begin; own < own_end && first < end; ++own) {
                const int begin = (int)runs[own].x + near.z, last = (int)runs[own].y + near.w;
                while (first < end && (int)runs[first].y < begin)
                    ++first;
                if (first == end || (int)runs[first].x > last)
                    continue;
                uint root = find_root(labels, own);
                for (uint next = first; next < end && (int)runs[next].x <= last; ++next) {
                    if (labels[next] == root)
                        continue;
                    const uint met = find_root(labels, next), least = min(root, met);
                    labels[max(root, met)] = least;
                    root = least;
                }
            }
        }
    }
    for (uint run = first_run; run < end_run; ++run) {
        const uint root = labels[labels[run]]; /* labels before this one are roots, and labels point there */
        labels[run] = root;
        if (root == run)
            roots[run] = run;
    }
}

/* Parameters  runs, row_counts, stencil, tables  in   as join_runs
 *             labels      in   (count) all of them roots
 *             row_links   out  (rows) pairs of runs of the row with runs of later parts, those of equal roots in
 *                              succession once
 *             nj, nk, part_rows  as join_runs
 * Launch      global = rows rounded up by the host, any local
 * Guarantees  every count is written */
__kernel void count_links(
    __global const ushort2 *restrict runs, __global const uint *restrict row_counts,
    __global const int4 *restrict stencil, __global const int2 *restrict tables, __global const uint *restrict labels,
    __global uint *restrict row_links, const int nj, const int nk, const uint part_rows)
{
    const uint row = get_global_id(0);
    if (row >= (uint)(nj * nk))
        return;
    const uint end_row = (row / part_rows + 1) * part_rows;
    row_links[row] = find_links(runs, row_counts, stencil, tables, labels, 0, nj, nk, row, end_row);
}

/* Parameters  as count_links, but
 *             row_links   in   (rows) pairs of all rows before
 *             links       out  (m, 3) the pairs as triangles (a, b, b) of roots, for union_find.cl
 * Launch      as count_links
 * Guarantees  every pair is written */
__kernel void list_links(
    __global const ushort2 *restrict runs, __global const uint *restrict row_counts,
    __global const int4 *restrict stencil, __global const int2 *restrict tables, __global const uint *restrict labels,
    __global const uint *restrict row_links, __global uint *restrict links, const int nj, const int nk,
    const uint part_rows)
{
    const uint row = get_global_id(0);
    if (row >= (uint)(nj * nk))
        return;
    const uint end_row = (row / part_rows + 1) * part_rows;
    find_links(runs, row_counts, stencil, tables, labels, links + 3 * (size_t)row_links[row], nj, nk, row, end_row);
}

/* Parameters  runs        in   (count)
 *             row_counts  in   (rows + 1) first run of each row, and `count`
 *             numbers     in   (count) component of each run
 *             marks       in/out  (components) 1 where the component reaches the border, else unchanged
 *             ni, nj, nk  columns, rows a slice, and slices
 *             by_slice    1: the border is that of each slice; 0: the first and the last slice are border too
 * Launch      global = nj nk rounded up by the host, any local
 * Guarantees  the same marks in any order */
__kernel void mark_border_runs(
    __global const ushort2 *restrict runs, __global const uint *restrict row_counts,
    __global const int *restrict numbers, __global uchar *marks, const int ni, const int nj, const int nk,
    const int by_slice)
{
    const uint row = get_global_id(0);
    if (row >= (uint)(nj * nk))
        return;
    const int j = row % nj, k = row / nj;
    const int all = j == 0 || j == nj - 1 || (!by_slice && (k == 0 || k == nk - 1));
    for (uint run = row_counts[row]; run < row_counts[row + 1]; ++run) {
        if (all || runs[run].x == 0 || runs[run].y == ni - 1)
            marks[numbers[run]] = 1;
    }
}

/* Parameters  voxels      in   (n, 3) voxels of the volume
 *             runs        in   (count)
 *             row_counts  in   (rows + 1) first run of each row, and `count`
 *             numbers     in   (count) component of each run
 *             marks       in/out  (components) 1 where the component holds a voxel of the list, else unchanged
 *             found       out  (n) component of each voxel, -1 where it lies in no run
 *             n           voxels;  nj  rows a slice
 * Launch      global = n rounded up by the host, any local
 * Guarantees  every component is written; the same marks in any order */
__kernel void mark_voxel_runs(
    __global const int *restrict voxels, __global const ushort2 *restrict runs,
    __global const uint *restrict row_counts, __global const int *restrict numbers, __global uchar *marks,
    __global int *restrict found, const uint n, const int nj)
{
    const uint which = get_global_id(0);
    if (which >= n)
        return;
    const int3 voxel = vload3(which, voxels);
    const int row = voxel.z * nj + voxel.y;
    int component = -1;
    for (uint run = row_counts[row]; run < row_counts[row + 1]; ++run)
        component = runs[run].x <= voxel.x && voxel.x <= runs[run].y ? numbers[run] : component;
    found[which] = component;
    if (component >= 0)
        marks[component] = 1;
}

/* Parameters  runs        in      (count) first and last column of each run, row by row; in a row in any order
 *             row_counts  in      (rows + 1) first run of each row, and `count`
 *             numbers     in      (count) component of each run
 *             marks       in      (components)
 *             mask        in/out  (rows, words) the bits of runs whose component has the mark `wanted` are set
 *             wanted      0 or 1
 *             rows, words
 * Launch      global = rows rounded up by the host, any local
 * Guarantees  each word is written by one item alone */
__kernel void write_runs(
    __global const ushort2 *restrict runs, __global const uint *restrict row_counts,
    __global const int *restrict numbers, __global const uchar *restrict marks, __global uint *restrict mask,
    const int wanted, const uint rows, const int words)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    __global uint *own = mask + (size_t)row * words;
    const uint end = row_counts[row + 1];
    for (uint run = row_counts[row]; run < end; ++run) {
        if (marks[numbers[run]] != wanted)
            continue;
        const int first = runs[run].x, last = runs[run].y;
        const uint from_first = ~0u << (first & 31), to_last = ~0u >> (31 - (last & 31));
        const int first_word = first >> 5, last_word = last >> 5;
        if (first_word == last_word) {
            own[first_word] |= from_first & to_last;
            continue;
        }
        own[first_word] |= from_first;
        for (int w = first_word + 1; w < last_word; ++w)
            own[w] = ~0u;
        own[last_word] |= to_last;
    }
}
