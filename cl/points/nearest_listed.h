/* The k nearest points on CPUs: candidates in private arrays, distances 8 at a time, order by counting smaller keys.
 *
 *      27 cells --copy--> x y z number place --squares--> those <= bound --count smaller keys--> sorted
 *
 * For LANES 8 alone: arrays of this size with an index that is known only at run time are too slow on GPUs. */
#ifndef CLRECON_NEAREST_LISTED_H
#define CLRECON_NEAREST_LISTED_H

#include "include/lanes.h"
#include "points/near_cells.h"

#define ROOM 384
#define MANY 48
#define WIDER 1.25f
/* Factor for squares, so that points whose distance rounds to the same float32 are not lost. */
#define SAME 1.000001f

/* Vectors at any place: some drivers call a function for each vload8 and vstore8. */
typedef float8 loose_float8 __attribute__((aligned(4)));
typedef int8 loose_int8 __attribute__((aligned(4)));
typedef long4 loose_long4 __attribute__((aligned(8)));
#define FLOATS_AT(pointer) (*(loose_float8 *)(pointer))
#define INTS_AT(pointer) (*(loose_int8 *)(pointer))
#define LONGS_AT(pointer) (*(loose_long4 *)(pointer))
#define GLOBAL_FLOATS_AT(pointer) (*(__global const loose_float8 *)(pointer))
#define GLOBAL_INTS_AT(pointer) (*(__global const loose_int8 *)(pointer))

/* Candidates around a point or a cell, and the nearest of them, sorted. */
typedef struct {
    float x[ROOM + 8], y[ROOM + 8], z[ROOM + 8];
    int number[ROOM + 8], place[ROOM + 8];
    float square[ROOM + 8];
    int kept[ROOM + 8];
    float kept_square[ROOM + 8];
    int kept_number[ROOM + 8];
    long keys[ROOM + 8];
    long sorted[ROOM + 8];
    int sorted_place[ROOM + 8];
    int count;
} candidates;

/* Copy points from to end - 1 behind the candidates; 0 if there is no room. */
static inline int copy_points(candidates *c, const cloud_grid *g, const uint from, const uint end)
{
    const int more = (int)(end - from);
    if (more > ROOM - c->count)
        return 0;
    for (int t = 0; t < more; t += 8) {
        const uint at = from + (uint)t;
        const int to = c->count + t;
        if (at + 8u <= g->points) {
            FLOATS_AT(c->x + to) = GLOBAL_FLOATS_AT(g->x + at);
            FLOATS_AT(c->y + to) = GLOBAL_FLOATS_AT(g->y + at);
            FLOATS_AT(c->z + to) = GLOBAL_FLOATS_AT(g->z + at);
            INTS_AT(c->number + to) = GLOBAL_INTS_AT(g->order + at);
        } else
            for (int lane = 0; lane < (int)(g->points - at); ++lane) {
                c->x[to + lane] = g->x[at + lane];
                c->y[to + lane] = g->y[at + lane];
                c->z[to + lane] = g->z[at + lane];
                c->number[to + lane] = (int)g->order[at + lane];
            }
        INTS_AT(c->place + to) = (int8)((int)at) + (int8)(0, 1, 2, 3, 4, 5, 6, 7);
    }
    c->count += more;
    return 1;
}

/* Copy the points of the 27 cells around a cell; 0 if there is no room. */
static inline int copy_block(candidates *c, const cloud_grid *g, const int3 cell)
{
    const int from = max(cell.x - 1, 0), end = min(cell.x + 2, g->nx);
    c->count = 0;
    for (int z = max(cell.z - 1, 0); z < min(cell.z + 2, g->nz); ++z)
        for (int y = max(cell.y - 1, 0); y < min(cell.y + 2, g->ny); ++y) {
            const uint2 range = points_of_window(g, (uint)z * (uint)g->ny + (uint)y, from, end);
            if (!copy_points(c, g, range.x, range.y))
                return 0;
        }
    return 1;
}

/* Squares of the distances of all candidates. */
static inline void find_squares(candidates *c, const float3 point)
{
    for (int t = 0; t < c->count; t += 8) {
        const float8 dx = FLOATS_AT(c->x + t) - point.x, dy = FLOATS_AT(c->y + t) - point.y;
        const float8 dz = FLOATS_AT(c->z + t) - point.z;
        FLOATS_AT(c->square + t) = dx * dx + dy * dy + dz * dz;
    }
}

/* List the candidates whose square is at most `bound`, and return their number. */
static inline int keep_near(candidates *c, const float bound)
{
    int count = 0;
    for (int t = 0; t < c->count; ++t) {
        c->kept[count] = t;
        count += c->square[t] <= bound;
    }
    return count;
}

static inline long sum_of(const long4 v) { return v.x + v.y + v.z + v.w; }

/* Sort the kept candidates by their keys: the place of each is the number of smaller keys. */
static inline void sort_kept(candidates *c, const int count)
{
    for (int t = 0; t < count; ++t) {
        c->kept_square[t] = c->square[c->kept[t]];
        c->kept_number[t] = c->number[c->kept[t]];
    }
    for (int t = 0; t < count; t += 8) {
        const int8 high = as_int8(sqrt(FLOATS_AT(c->kept_square + t))), low = INTS_AT(c->kept_number + t);
        const int8 first = (int8)(low.s0, high.s0, low.s1, high.s1, low.s2, high.s2, low.s3, high.s3);
        const int8 second = (int8)(low.s4, high.s4, low.s5, high.s5, low.s6, high.s6, low.s7, high.s7);
        LONGS_AT(c->keys + t) = as_long4(first);
        LONGS_AT(c->keys + t + 4) = as_long4(second);
    }
    for (int t = count; t < count + 4; ++t)
        c->keys[t] = LONG_MAX;
    for (int t = 0; t < count; t += 4) {
        const long4 own = LONGS_AT(c->keys + t);
        long4 a = 0, b = 0, d = 0, e = 0;
        for (int other = 0; other < count; other += 4) {
            const long4 key = LONGS_AT(c->keys + other);
            a -= key < (long4)(own.x);
            b -= key < (long4)(own.y);
            d -= key < (long4)(own.z);
            e -= key < (long4)(own.w);
        }
        const long4 ranks = (long4)(sum_of(a), sum_of(b), sum_of(d), sum_of(e));
        c->sorted[ranks.x] = own.x;
        c->sorted_place[ranks.x] = c->place[c->kept[t]];
        if (t + 1 < count) {
            c->sorted[ranks.y] = own.y;
            c->sorted_place[ranks.y] = c->place[c->kept[t + 1]];
        }
        if (t + 2 < count) {
            c->sorted[ranks.z] = own.z;
            c->sorted_place[ranks.z] = c->place[c->kept[t + 2]];
        }
        if (t + 3 < count) {
            c->sorted[ranks.w] = own.w;
            c->sorted_place[ranks.w] = c->place[c->kept[t + 3]];
        }
    }
}

static inline float distance_of(const long key) { return as_float((int)(key >> 32)); }

/* Sort the k nearest candidates of a point.  Returns the distance to the kth; infinity where there are fewer than k.
 * `bound` is a guess of its square, and becomes the next one, not below a tenth of an edge. */
static inline float sort_nearest(candidates *c, const int k, const float edge, float *bound)
{
    if (c->count < k)
        return INFINITY;
    const int many = max(MANY, 2 * k);
    float low = 0.0f, high = INFINITY, limit = *bound;
    int count = keep_near(c, limit);
    for (int tries = 0; tries < 12 && (count < k || count > many); ++tries) {
        if (count < k)
            low = limit;
        else
            high = limit;
        limit = high < INFINITY ? 0.5f * (low + high) : 1.6f * limit;
        count = keep_near(c, limit);
    }
    for (;;) {
        if (count < k) {
            limit = high < INFINITY && limit < high ? high : INFINITY;
            count = keep_near(c, limit);
        }
        sort_kept(c, count);
        const float farthest = distance_of(c->sorted[k - 1]);
        if (farthest * farthest * SAME <= limit) {
            *bound = max(WIDER * farthest * farthest, 0.01f * edge * edge);
            return farthest;
        }
        limit = limit * 1.01f + 1e-30f;
        count = keep_near(c, limit);
    }
}

/* Keep only the k nearest candidates, in their order.  Returns the square within which all others may be left out. */
static inline float shrink(candidates *c, const int k)
{
    for (int t = 0; t < c->count; ++t)
        c->kept[t] = t;
    sort_kept(c, c->count);
    const long last = c->sorted[k - 1];
    int count = 0;
    for (int t = 0; t < c->count; ++t) {
        const float root = sqrt(c->square[t]);
        const long key = (long)as_int(root) << 32 | (long)c->number[t];
        c->x[count] = c->x[t];
        c->y[count] = c->y[t];
        c->z[count] = c->z[t];
        c->square[count] = c->square[t];
        c->number[count] = c->number[t];
        c->place[count] = c->place[t];
        count += key <= last;
    }
    c->count = count;
    const float farthest = distance_of(last);
    return farthest * farthest * SAME;
}

static inline int add_point(
    candidates *c, const cloud_grid *g, const uint at, const float square, const int k, float *bound)
{
    c->x[c->count] = g->x[at];
    c->y[c->count] = g->y[at];
    c->z[c->count] = g->z[at];
    c->square[c->count] = square;
    c->number[c->count] = (int)g->order[at];
    c->place[c->count] = (int)at;
    if (++c->count == ROOM)
        *bound = min(*bound, shrink(c, k));
    return *bound == 0.0f;
}

/* Add the points from to end - 1 whose square is at most `bound`, which falls while candidates come in.  Returns 1 once
 * there are k at distance 0: within a cell these have the lowest numbers. */
static inline int add_near(
    candidates *c, const cloud_grid *g, const float3 point, const uint from, const uint end, const int k, float *bound)
{
    uint at = from;
    for (; at < end && at + 8u <= g->points; at += 8u) {
        const float8 dx = GLOBAL_FLOATS_AT(g->x + at) - point.x, dy = GLOBAL_FLOATS_AT(g->y + at) - point.y;
        const float8 dz = GLOBAL_FLOATS_AT(g->z + at) - point.z;
        const float8 square = dx * dx + dy * dy + dz * dz;
        if (!ANY_LANE(square <= *bound))
            continue;
        float lane_of[8];
        FLOATS_AT(lane_of) = square;
        for (uint lane = 0; lane < min(end - at, 8u); ++lane)
            if (lane_of[lane] <= *bound && add_point(c, g, at + lane, lane_of[lane], k, bound))
                return 1;
    }
    for (; at < end; ++at) {
        const float dx = g->x[at] - point.x, dy = g->y[at] - point.y, dz = g->z[at] - point.z;
        const float square = dx * dx + dy * dy + dz * dz;
        if (square <= *bound && add_point(c, g, at, square, k, bound))
            return 1;
    }
    return 0;
}

/* Find the k nearest of a point whose block of 27 cells is not enough or has no room: from cells at most 1, 2, ... steps
 * away, until no others can be nearer.  `farthest` is a distance within which there are k points, or infinity. */
static inline void sort_far(
    candidates *c, const cloud_grid *g, const float3 point, const int3 cell, const int k, const float3 origin,
    const float edge, const float margin, float farthest)
{
    const int all = max(g->nx, max(g->ny, g->nz));
    int r = farthest < INFINITY ? min(max(2, (int)((farthest + margin) / edge) + 1), all) : 1;
    for (;;) {
        float bound = farthest * farthest * SAME;
        c->count = 0;
        const uint own_row = (uint)cell.z * (uint)g->ny + (uint)cell.y;
        const uint2 own = points_of_window(g, own_row, cell.x, cell.x + 1);
        int done = add_near(c, g, point, own.x, own.y, k, &bound);
        const int from = max(cell.x - r, 0), end = min(cell.x + r + 1, g->nx);
        const int low_y = max(cell.y - r, 0), high_y = min(cell.y + r + 1, g->ny);
        for (int z = max(cell.z - r, 0); z < min(cell.z + r + 1, g->nz) && !done; ++z) {
            const uint first_row = (uint)z * (uint)g->ny;
            if (rows_are_empty(g, first_row + (uint)low_y, first_row + (uint)high_y))
                continue;
            for (int y = low_y; y < high_y && !done; ++y) {
                if (far_from_row(point, y, z, origin, edge, margin) > bound)
                    continue;
                const uint2 range = points_of_window(g, first_row + (uint)y, from, end);
                if (first_row + (uint)y != own_row)
                    done = add_near(c, g, point, range.x, range.y, k, &bound);
                else
                    done = add_near(c, g, point, range.x, own.x, k, &bound)
                        || add_near(c, g, point, own.y, range.y, k, &bound);
            }
        }
        if (c->count >= k) {
            for (int t = 0; t < c->count; ++t)
                c->kept[t] = t;
            sort_kept(c, c->count);
            farthest = distance_of(c->sorted[k - 1]);
            if (done || r >= all || farthest < reach_of_block(g, point, cell, r, origin, edge, margin))
                return;
            r = min(max(r + 1, (int)((farthest + margin) / edge) + 1), all);
        } else
            r = min(2 * r, all);
    }
}

#endif
