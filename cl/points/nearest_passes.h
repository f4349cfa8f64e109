/* The k nearest points on GPUs: four in each pass over the candidates, in registers. */
#ifndef CLRECON_NEAREST_PASSES_H
#define CLRECON_NEAREST_PASSES_H

#include "points/near_cells.h"

/* The square root, correctly rounded: drivers may be off by three steps.  B. Tuckerman's test, in W. Kahan, "Paranoia",
 * 1983: s is right if s times the step before is below x, and s times the step after is not. */
static inline float exact_root(const float x)
{
    float root = sqrt(x);
    if (!(root > 0.0f))
        return root;
    for (float below = as_float(as_int(root) - 1); fma(-root, below, x) <= 0.0f; below = as_float(as_int(root) - 1))
        root = below;
    for (float above = as_float(as_int(root) + 1); fma(-root, above, x) > 0.0f; above = as_float(as_int(root) + 1))
        root = above;
    return root;
}

/* The next neighbours found, ascending by key, with their places. */
typedef struct {
    ulong key0, key1, key2, key3;
    uint place0, place1, place2, place3;
} next_four;

static inline void insert_key(next_four *best, const ulong key, const uint place)
{
    if (key >= best->key3)
        return;
    const int before2 = key < best->key2, before1 = key < best->key1, before0 = key < best->key0;
    best->key3 = before2 ? best->key2 : key;
    best->place3 = before2 ? best->place2 : place;
    best->key2 = before1 ? best->key1 : before2 ? key : best->key2;
    best->place2 = before1 ? best->place1 : before2 ? place : best->place2;
    best->key1 = before0 ? best->key0 : before1 ? key : best->key1;
    best->place1 = before0 ? best->place0 : before1 ? place : best->place1;
    best->key0 = before0 ? key : best->key0;
    best->place0 = before0 ? place : best->place0;
}

/* Find the four smallest keys that are not below `least`, of points in cells at most r steps away. */
static inline next_four find_next(
    const cloud_grid *g, const float3 point, const int3 cell, const int r, const float3 origin, const float edge,
    const float margin, const ulong least, const float bound)
{
    next_four best = {ULONG_MAX, ULONG_MAX, ULONG_MAX, ULONG_MAX, 0, 0, 0, 0};
    const int from = max(cell.x - r, 0), end = min(cell.x + r + 1, g->nx);
    const int low_y = max(cell.y - r, 0), high_y = min(cell.y + r + 1, g->ny);
    for (int z = max(cell.z - r, 0); z < min(cell.z + r + 1, g->nz); ++z) {
        const uint first_row = (uint)z * (uint)g->ny;
        if (rows_are_empty(g, first_row + (uint)low_y, first_row + (uint)high_y))
            continue;
        for (int y = low_y; y < high_y; ++y) {
            if (far_from_row(point, y, z, origin, edge, margin) > bound)
                continue;
            const uint2 range = points_of_window(g, first_row + (uint)y, from, end);
            for (uint at = range.x; at < range.y; ++at) {
                const float dx = g->x[at] - point.x, dy = g->y[at] - point.y, dz = g->z[at] - point.z;
                const float square = dx * dx + dy * dy + dz * dz;
                const ulong key = (ulong)as_uint(exact_root(square)) << 32 | (ulong)g->order[at];
                if (key >= least)
                    insert_key(&best, key, at);
            }
        }
    }
    return best;
}

static inline void write_key(
    const ulong key, const uint place, const int t, const size_t row, const int k, const int by_place,
    __global int *restrict neighbours, __global float *restrict distances)
{
    if (t >= k || key == ULONG_MAX)
        return;
    neighbours[row * (size_t)k + (size_t)t] = by_place ? (int)place : (int)(uint)key;
    if (!by_place)
        distances[row * (size_t)k + (size_t)t] = as_float((uint)(key >> 32));
}

/* Write the first k points at the place of a point, as far as there are k in its cell: they have the lowest numbers. */
static inline int list_equal(
    const cloud_grid *g, const float3 point, const int3 cell, const size_t row, const int k, const int by_place,
    __global int *restrict neighbours, __global float *restrict distances)
{
    const uint2 own = points_of_window(g, (uint)cell.z * (uint)g->ny + (uint)cell.y, cell.x, cell.x + 1);
    int found = 0;
    for (uint at = own.x; at < own.y && found < k; ++at) {
        const float dx = g->x[at] - point.x, dy = g->y[at] - point.y, dz = g->z[at] - point.z;
        if (dx * dx + dy * dy + dz * dz == 0.0f)
            write_key((ulong)g->order[at], at, found++, row, k, by_place, neighbours, distances);
    }
    return found == k;
}

/* Find the neighbours of one point. */
static inline void list_point(
    const cloud_grid *g, const uint place, const int k, const float3 origin, const float edge, const float margin,
    const int by_place, const uint first_place, __global int *restrict neighbours, __global float *restrict distances)
{
    const float3 point = (float3)(g->x[place], g->y[place], g->z[place]);
    const uint number = cell_of_place(g->starts, g->cells, place), word = word_of_cell(g, number);
    const int3 cell = place_of_bit(g, word, nth_bit(g->mask[word], number - g->ranks[word]));
    const size_t row = by_place ? place - first_place : g->order[place];
    if (list_equal(g, point, cell, row, k, by_place, neighbours, distances))
        return;
    const int all = max(g->nx, max(g->ny, g->nz));
    float bound = INFINITY;
    for (int r = 1;;) {
        ulong last = 0, least = 0;
        int found = 0;
        while (found < k && last != ULONG_MAX) {
            const next_four best = find_next(g, point, cell, r, origin, edge, margin, least, bound);
            write_key(best.key0, best.place0, found, row, k, by_place, neighbours, distances);
            write_key(best.key1, best.place1, found + 1, row, k, by_place, neighbours, distances);
            write_key(best.key2, best.place2, found + 2, row, k, by_place, neighbours, distances);
            write_key(best.key3, best.place3, found + 3, row, k, by_place, neighbours, distances);
            const int left = k - found;
            last = left == 1 ? best.key0 : left == 2 ? best.key1 : left == 3 ? best.key2 : best.key3;
            least = best.key3 + 1;
            found += 4;
        }
        if (last != ULONG_MAX) {
            const float farthest = as_float((uint)(last >> 32));
            if (r >= all || farthest < reach_of_block(g, point, cell, r, origin, edge, margin))
                return;
            bound = farthest * farthest * 1.000001f;
            r = min(max(r + 1, (int)((farthest + margin) / edge) + 1), all);
        } else
            r = min(2 * r, all);
    }
}

#endif
