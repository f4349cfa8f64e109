/* Vertices on crossed edges, gathered one by one and computed LANES at a time.
 *
 * Gathering differs from vertex to vertex: it finds the edge and the values around it.  Computing is the same
 * arithmetic for all vertices: the place of the surface on the edge, its position in mm, its normal. */
#ifndef CLRECON_VERTEX_GROUP_H
#define CLRECON_VERTEX_GROUP_H

#include "include/lanes.h"
#include "include/volume.h"

/* The edges of up to LANES vertices.  Gradients are twice the change of the field per index step, at the owner of the
 * edge and at its other end. */
typedef struct {
    int i[LANES], j[LANES], axis[LANES];
    VALUE value[LANES], next_value[LANES];
    VALUE gradient_i[LANES], gradient_j[LANES], gradient_k[LANES];
    VALUE next_gradient_i[LANES], next_gradient_j[LANES], next_gradient_k[LANES];
#ifdef LABELS
    int half_way[LANES]; /* not placed by HU, see label_border.h */
#endif
} vertex_group;

/* What the vertices of one slice have in common. */
typedef struct {
    float3 origin, origin_rest; /* mm of sample (0, 0, k), rounded to 12 bits, and the rest */
    float3 i_step, i_rest, j_step, j_rest; /* mm for one step along i and j, likewise */
    float3 k_step; /* mm to the next slice */
    float3 normal_x, normal_y, normal_z; /* rows of the matrix from gradients per step to gradients per mm */
#ifdef UNEVEN
    float3 next_normal_x, next_normal_y, next_normal_z; /* those of the next slice */
#endif
    float3 margin; /* smallest distance of a vertex from a sample, in steps */
    float iso_level, value_scale;
#ifdef RANGE
    float upper_level, highest; /* where the surface lies above the range, and the range's highest value */
#endif
} slice_frame;

/* The parameters of a kernel for the upper end of a range, and where they are kept. */
#ifdef RANGE
#define RANGE_PARAMETERS , const float upper_level, const float highest
#define RANGE_ARGUMENTS , upper_level, highest
static inline void set_upper_end(slice_frame *frame, const float upper_level, const float highest)
{
    frame->upper_level = upper_level;
    frame->highest = highest;
}
#else
#define RANGE_PARAMETERS
#define RANGE_ARGUMENTS
static inline void set_upper_end(slice_frame *frame) {}
#endif

#define FRAME_ROWS 9

/* Fill in what differs from slice to slice, for vertices on edges from the samples of slice k of gk. */
static inline void load_slice_frame(slice_frame *frame, __global const float4 *slice_frames, uint k, uint gk)
{
    __global const float4 *row = slice_frames + FRAME_ROWS * (size_t)k;
    frame->origin = row[0].xyz;
    frame->origin_rest = row[1].xyz;
    frame->k_step = row[2].xyz;
    frame->margin.z = row[2].w; /* layers may be of very different thickness */
    frame->normal_x = row[3].xyz;
    frame->normal_y = row[4].xyz;
    frame->normal_z = row[5].xyz;
#ifdef UNEVEN
    row = slice_frames + FRAME_ROWS * (size_t)min(k + 1, gk - 1);
    frame->next_normal_x = row[3].xyz;
    frame->next_normal_y = row[4].xyz;
    frame->next_normal_z = row[5].xyz;
#endif
}

/* Twice the gradient in one direction, from the values before and after; one-sided at the ends of an open volume. */
static inline VALUE double_gradient(VALUE before, VALUE after, int at, int n, int closed)
{
    const VALUE change = after - before;
    return !closed && (at == 0 || at == n - 1) ? change + change : change;
}

/* Gather the vertex on the edge from sample (i, j, k) along `axis` (0, 1, 2: towards i + 1, j + 1, k + 1) as lane n.
 * `inner` says that every value around the edge is a voxel of the volume. */
static inline __attribute__((always_inline)) void gather_vertex( /* else a group lies in memory where two call it */
    vertex_group *group, uint n, const volume_part *volume, int i, int j, int k, int axis, int inner)
{
    group->i[n] = i;
    group->j[n] = j;
    group->axis[n] = axis;
    if (inner) {
        const size_t row = volume->ni, slice = row * (size_t)volume->nj;
        __global const VOXEL *at = volume->voxels + voxel_index(i, j, k - volume->first_k, volume->ni, volume->nj);
        __global const VOXEL *next = at + (axis == 0 ? 1 : axis == 1 ? row : slice);
        group->value[n] = *at;
        group->next_value[n] = *next;
        group->gradient_i[n] = (VALUE)at[1] - (VALUE)*(at - 1);
        group->gradient_j[n] = (VALUE)at[row] - (VALUE)*(at - row);
        group->gradient_k[n] = (VALUE)at[slice] - (VALUE)*(at - slice);
        group->next_gradient_i[n] = (VALUE)next[1] - (VALUE)*(next - 1);
        group->next_gradient_j[n] = (VALUE)next[row] - (VALUE)*(next - row);
        group->next_gradient_k[n] = (VALUE)next[slice] - (VALUE)*(next - slice);
        return;
    }
    const int ni = volume->ni, nj = volume->nj, nk = volume->nk, closed = volume->closed;
    const int i1 = i + (axis == 0), j1 = j + (axis == 1), k1 = k + (axis == 2);
#define SAMPLE(i, j, k) sample_volume(volume, i, j, k)
    group->value[n] = SAMPLE(i, j, k);
    group->next_value[n] = SAMPLE(i1, j1, k1);
    group->gradient_i[n] = double_gradient(SAMPLE(i - 1, j, k), SAMPLE(i + 1, j, k), i, ni, closed);
    group->gradient_j[n] = double_gradient(SAMPLE(i, j - 1, k), SAMPLE(i, j + 1, k), j, nj, closed);
    group->gradient_k[n] = double_gradient(SAMPLE(i, j, k - 1), SAMPLE(i, j, k + 1), k, nk, closed);
    group->next_gradient_i[n] = double_gradient(SAMPLE(i1 - 1, j1, k1), SAMPLE(i1 + 1, j1, k1), i1, ni, closed);
    group->next_gradient_j[n] = double_gradient(SAMPLE(i1, j1 - 1, k1), SAMPLE(i1, j1 + 1, k1), j1, nj, closed);
    group->next_gradient_k[n] = double_gradient(SAMPLE(i1, j1, k1 - 1), SAMPLE(i1, j1, k1 + 1), k1, nk, closed);
#undef SAMPLE
}

/* Prefetch the rows of the volume that the edges of 32 samples from (i, j, k) on touch, except those that the rows
 * before have touched.  Does nothing where the driver knows no prefetch. */
static inline void prefetch_around(const volume_part *volume, int i, int j, int k)
{
#ifdef HAS_BUILTIN_PREFETCH
    const int ni = volume->ni, nj = volume->nj, nk = volume->nk;
    if (i < 0 || i + 32 > ni || j < 1 || j > nj - 3 || k < 0 || k > nk - 3)
        return;
    const size_t row = ni, slice = row * (size_t)nj;
    __global const VOXEL *at = volume->voxels + voxel_index(i, j, k - volume->first_k, ni, nj);
#define PREFETCH_AT(place) __builtin_prefetch((const void *)(size_t)(at + (place)))
    PREFETCH_AT(0);
    PREFETCH_AT(row);
    PREFETCH_AT(slice - row);
    PREFETCH_AT(slice);
    PREFETCH_AT(slice + row);
    PREFETCH_AT(2 * slice);
    PREFETCH_AT(2 * slice + 31);
#undef PREFETCH_AT
#endif
}

/* Sum of two floats; `error` grows by what rounding left (Knuth). */
static inline floats add_exactly(floats a, floats b, floats *error)
{
    const floats sum = a + b;
    const floats part = sum - a;
    *error += (a - (sum - part)) + (b - part);
    return sum;
}

/* One coordinate of the positions: an exact sum of the origin and the steps, plus the small terms. */
static inline floats place_vertices(
    floats i, floats j, floats t, ints along_j, ints along_k,
    float origin, float origin_rest, float i_step, float i_rest, float j_step, float j_rest, float k_step)
{
    floats rest = origin_rest + (i * i_rest + j * j_rest);
    floats place = add_exactly((floats)(origin), j * j_step, &rest);
    place = add_exactly(place, i * i_step, &rest);
    const floats step
        = choose(along_k, (floats)(k_step), choose(along_j, (floats)(j_step + j_rest), (floats)(i_step + i_rest)));
    return place + (rest + t * step);
}

/* Write x, y, z of the first `count` lanes as consecutive triples. */
static inline void store_triples(floats x, floats y, floats z, uint count, __global float *out)
{
#if LANES == 8
    const float8 low = (float8)(x.s0, y.s0, z.s0, x.s1, y.s1, z.s1, x.s2, y.s2);
    const float8 middle = (float8)(z.s2, x.s3, y.s3, z.s3, x.s4, y.s4, z.s4, x.s5);
    const float8 high = (float8)(y.s5, z.s5, x.s6, y.s6, z.s6, x.s7, y.s7, z.s7);
    if (count == LANES) {
        vstore8(low, 0, out);
        vstore8(middle, 1, out);
        vstore8(high, 2, out);
        return;
    }
    float triples[3 * LANES];
    vstore8(low, 0, triples);
    vstore8(middle, 1, triples);
    vstore8(high, 2, triples);
    for (uint n = 0; n < 3 * count; ++n)
        out[n] = triples[n];
#else
    vstore3((float3)(x, y, z), 0, out);
#endif
}

#define GOLDEN_SECTION 0.6180340f
#define SEARCH_STEPS 24 /* the last part of an edge is 0.618^24, 1e-5 of it */

#ifdef GOLDEN_SEARCH
/* Where the cubic of Catmull and Rom through the two values of each edge and those beside it crosses the level, by
 * golden sections: of both parts that which has its ends on both sides of the level is cut again. */
static inline floats search_crossing(
    const vertex_group *group, ints axis, floats value, floats next_value, floats level)
{
#define ALONG(which) choose(axis == 2, to_floats(load_lanes(group->which##_k)), \
        choose(axis == 1, to_floats(load_lanes(group->which##_j)), to_floats(load_lanes(group->which##_i))))
    const floats rise = 0.5f * ALONG(gradient), next_rise = 0.5f * ALONG(next_gradient);
#undef ALONG
    const floats change = next_value - value;
    const floats second = 3.0f * change - 2.0f * rise - next_rise, third = rise + next_rise - 2.0f * change;
    const floats height = level - value; /* the cubic begins at 0 */
    const ints rises = next_value > value;
    floats low = (floats)(0.0f), high = (floats)(1.0f);
    for (int step = 0; step < SEARCH_STEPS; ++step) {
        const floats cut = low + GOLDEN_SECTION * (high - low);
        const floats reached = cut * (rise + cut * (second + cut * third));
        const ints beyond = choose(rises, reached, -reached) >= choose(rises, height, -height);
        low = choose(beyond, low, cut);
        high = choose(beyond, cut, high);
    }
    return 0.5f * (low + high);
}
#endif

/* Compute the first `count` vertices of a group and write them from `positions` and `normals` on. */
static inline void write_vertices(
    const vertex_group *group, const slice_frame *frame, uint count,
    __global float *positions, __global float *normals)
{
    const ints axis = load_lanes(group->axis);
    const ints along_j = axis == 1, along_k = axis == 2;
    const floats value = to_floats(load_lanes(group->value));
    const floats next_value = to_floats(load_lanes(group->next_value));
#ifdef GOLDEN
    floats t = (floats)(GOLDEN_SECTION);
#else
    /* A sum, since compilers make an index of run time of choices among the elements of a vector. */
    const floats none = 0.0f;
    const floats keep = choose(axis == 0, (floats)(frame->margin.x), none)
        + (choose(along_j, (floats)(frame->margin.y), none) + choose(along_k, (floats)(frame->margin.z), none));
#ifdef RANGE
    /* One end is inside: the other one lies above the range where the larger of both does. */
    const ints above = greater(value, next_value) > frame->highest;
    const floats level = choose(above, (floats)(frame->upper_level), (floats)(frame->iso_level));
#else
    const float level = frame->iso_level;
#endif
#ifdef GOLDEN_SEARCH
    floats t = clamp(search_crossing(group, axis, value, next_value, level), keep, 1.0f - keep);
#else
    floats t = clamp((level - value) / (next_value - value), keep, 1.0f - keep);
#endif
#endif
    floats value_scale = (floats)(frame->value_scale);
#ifdef LABELS
    const ints half_way = load_lanes(group->half_way) != 0;
    t = choose(half_way, (floats)(0.5f), t);
    value_scale = choose(half_way, (floats)(1.0f), value_scale);
#endif

    const floats i = to_floats(load_lanes(group->i)), j = to_floats(load_lanes(group->j));
#define PLACE(c) place_vertices(i, j, t, along_j, along_k, frame->origin.c, frame->origin_rest.c, \
        frame->i_step.c, frame->i_rest.c, frame->j_step.c, frame->j_rest.c, frame->k_step.c)
    store_triples(PLACE(x), PLACE(y), PLACE(z), count, positions);
#undef PLACE

#define GRADIENT(c) to_floats(load_lanes(group->gradient_##c))
#define NEXT_GRADIENT(c) to_floats(load_lanes(group->next_gradient_##c))
#define SLOPE(c) (value_scale * (GRADIENT(c) + t * (NEXT_GRADIENT(c) - GRADIENT(c))))
    floats slope_i = SLOPE(i), slope_j = SLOPE(j), slope_k = SLOPE(k);
#undef SLOPE
    /* Where the differences cancel, the edge itself says which way is down. */
    const ints flat = slope_i * slope_i + slope_j * slope_j + slope_k * slope_k == 0.0f;
    const floats up = choose(next_value > value, (floats)(1.0f), (floats)(-1.0f));
#ifdef UNEVEN
    /* The two ends of an edge along k have steps of their own: each part of the slope goes through its own matrix. */
#define NEXT_PART(c) choose(along_k & ~flat, value_scale * t * NEXT_GRADIENT(c), (floats)(0.0f))
    const floats next_i = NEXT_PART(i), next_j = NEXT_PART(j), next_k = NEXT_PART(k);
#undef NEXT_PART
    slope_i -= next_i;
    slope_j -= next_j;
    slope_k -= next_k;
#endif
    slope_i = choose(flat & (axis == 0), up, slope_i);
    slope_j = choose(flat & along_j, up, slope_j);
    slope_k = choose(flat & along_k, up, slope_k);
#define NORMAL(c) (frame->normal_##c.x * slope_i + frame->normal_##c.y * slope_j + frame->normal_##c.z * slope_k)
    floats x = NORMAL(x), y = NORMAL(y), z = NORMAL(z);
#undef NORMAL
#ifdef UNEVEN
#define NORMAL(c) (frame->next_normal_##c.x * next_i + frame->next_normal_##c.y * next_j \
        + frame->next_normal_##c.z * next_k)
    x += NORMAL(x);
    y += NORMAL(y);
    z += NORMAL(z);
#undef NORMAL
#endif
#undef NEXT_GRADIENT
#undef GRADIENT
#ifdef RANGE
    const floats scale = choose(above, (floats)(1.0f), (floats)(-1.0f)) / sqrt(x * x + y * y + z * z);
#else
    const floats scale = -1.0f / sqrt(x * x + y * y + z * z);
#endif
    store_triples(x * scale, y * scale, z * scale, count, normals);
}

#endif
