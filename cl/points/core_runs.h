/* Runs of core voxels: which of them are neighbours, and the labels that they give to the voxels beside them.
 *
 * Arguments are not `restrict`: inlined, it becomes an instruction that Oclgrind 21.10 does not know. */
#ifndef CLRECON_CORE_RUNS_H
#define CLRECON_CORE_RUNS_H

/* The root of a run of this item's own part; halves the way to it. */
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

/* Bits of one word, as load_shifted. */
static inline uint shifted_word(__global const uint *mask, const int at, const int shift, const int total)
{
    const int word = at + (shift >> 5);
    const uint bits = shift & 31;
    const uint low = word >= 0 && word < total ? mask[word] : 0;
    const uint high = bits != 0 && word + 1 >= 0 && word + 1 < total ? mask[word + 1] << (32 - bits) : 0;
    return low >> bits | high;
}

static inline void fill_labels(__global int *to, int count, const int number)
{
    for (; count >= 8; count -= 8, to += 8)
        vstore8((int8)(number), 0, to);
    for (int place = 0; place < count; ++place)
        to[place] = number;
}

/* Give the set voxels of a row that are no core voxels the lowest number among core voxels of one row of the stencil. */
static inline void label_borders(
    __global const uint *mask, __global const uint *cores, __global const ushort2 *runs,
    __global const int *numbers, __global int *labels, const int4 near, const int own_at,
    const int other_at, uint run, const uint end_run, const ushort2 extent, const int total)
{
    uint point = 0;
    for (int w = extent.x; w < extent.y; ++w) {
        const uint bits = mask[own_at + w], open = bits & ~cores[own_at + w];
        uint met = 0;
        if (open != 0) {
            for (int di = near.z; di <= near.w && (open & ~met) != 0; ++di)
                met |= shifted_word(cores, other_at + w, di, total);
        }
        for (uint border = met & open; border != 0; border &= border - 1) {
            const uint below = (border & -border) - 1;
            const int column = 32 * w + popcount(below);
            while (run < end_run && (int)runs[run].y < column + near.z)
                ++run;
            int lowest = labels[point + popcount(bits & below)];
            for (uint next = run; next < end_run && (int)runs[next].x <= column + near.w; ++next)
                lowest = lowest < 0 ? numbers[next] : min(lowest, numbers[next]);
            labels[point + popcount(bits & below)] = lowest;
        }
        point += popcount(bits);
    }
}

#endif
