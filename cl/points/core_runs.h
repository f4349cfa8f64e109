/* Runs of core voxels: the labels that they give to the voxels beside them.
 *
 * Arguments are not `restrict`: inlined, it becomes an instruction that Oclgrind 21.10 does not know. */
#ifndef CLRECON_CORE_RUNS_H
#define CLRECON_CORE_RUNS_H

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
