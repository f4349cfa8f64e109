/* Samples of a packet of rays, and segments in parts where the transfer function is steep.
 *
 * A segment has its sample in its middle.  Where the transfer function is steep between that sample and its neighbours
 * the segment is taken in PARTS parts, with values of a parabola through these samples (pre-integrated tables take a
 * line: Engel, Kraus and Ertl 2001, "High-quality pre-integrated volume rendering"; lines cut the tops of thin bone
 * off), and its light and colour are those of the place where it is seen: without that, surfaces have rings like the
 * grain of wood.  What the twin in clrecon/proof/rays/render.py does without leaps comes out the same: bricks that show
 * nothing hold no values between which something shows. */
#ifndef CLRECON_STEEP_SEGMENTS_H
#define CLRECON_STEEP_SEGMENTS_H

#include "rays/field.h"
#include "rays/label_color.h"
#include "rays/leap.h"
#include "rays/stack.h"

#define NODES 4096 /* of the transfer function's table */
#define PARTS 4 /* of a segment that is steep */
#define STEEP 0.1f /* opacity that comes or goes within a step: more is steep */
#define DENSE 0.7f /* opacity of a step of which only the front is seen: as steep ones */
#ifndef TAKES_PARTS
#define TAKES_PARTS 0
#endif
#define BESIDE TAKES_PARTS /* samples at either side of a segment that it needs */

/* Rays in samples: number n is at t = t_in + (n + phase) * ray_step.  The last segment, number `last`, is what is left
 * of the way: its length is `rest`, and its sample has the number `last_number`, a fraction. */
typedef struct {
    floats t_in, phase, offset, last, last_number, rest;
    floats begin, end; /* samples that can show */
    floats toward_x, toward_y, toward_z; /* unit direction, LPS */
    float inner_begin, inner_end; /* samples of which all rays have every voxel that they need, see find_opacity() */
} packet;

/* Transfer function and light. */
typedef struct {
    __global const int *colors; /* blue, green, red, 10 bits each */
    __global const float *opacities; /* over one ray step */
    __global const float *clears; /* what a part of a step lets through */
    __global const float *changes; /* of the opacity, summed up from the first node on */
    float narrow; /* nodes within which nothing is steep */
    __global const float *highlights;
    __global const float *factors; /* on the opacity, by magnitude of the gradient */
    __global const float4 *view;
    float low, scale; /* nearest node to a value v: (v - low) * scale + 0.5 */
    float factor_scale; /* entry of a magnitude m, a fraction: m * factor_scale */
    float steps_per_unit; /* ray steps in the unit distance */
    float ray_step;
    float slab_low, slab_high; /* samples with slab_low <= k < slab_high are this slab's */
    float first_value, last_value; /* in nodes: what shows anything is at least the first and below the last */
    int shaded;
    __global const LABEL *labels; /* with -D LABELS, as the next */
    __global const float4 *label_colors;
} looks;

/* Indices of sample n of each ray; unless `inner`, no farther than the last. */
static inline void find_places(const slice_stack *stack, const ray_lanes *course, const packet *rays, const floats n,
    const int inner, floats *i, floats *j, floats *k)
{
    const floats number = inner ? n : lesser(n, rays->last_number);
    *i = course->start_i + number * course->stride_i;
    *j = course->start_j + number * course->stride_j;
    *k = course->start_k + number * course->stride_k;
    to_indices(stack, i, j, k);
}

/* Value of sample n of each ray in nodes of the transfer function, a fraction; `inner` as in find_opacity(). */
static inline floats find_value(const field *f, const slice_stack *stack, const looks *look, const ray_lanes *course,
    const packet *rays, const floats n, const int inner)
{
    floats i, j, k;
    find_places(stack, course, rays, n, inner, &i, &j, &k);
    return (sample_lanes(f, i, j, k, inner) - look->low) * look->scale + 0.5f;
}

static inline ints find_node(const floats value)
{
    return to_ints(lesser(greater(value, (floats)(0.0f)), (floats)(NODES - 1)));
}

/* Values of the samples before a segment, in its middle, and after it; without parts that in its middle alone. */
#if TAKES_PARTS
typedef struct {
    floats before, here, after;
    float reach; /* twice the share of the way to `before` that values may go: half of it lies before the ray */
    int may_be_steep;
} segment_values;

/* Opacity over one ray step of a segment whose values run through its sample and the neighbours, where that is steep;
 * `shift` is the place where it is seen, in samples from its own, 0 where it is not steep, and `value` is that of this
 * place. */
static inline floats find_steep_opacity(
    const looks *look, const segment_values *v, const ints counts, const floats opacity, floats *shift, floats *value)
{
    *shift = 0.0f;
    *value = v->here;
    if (!v->may_be_steep)
        return opacity;
    /* What surely shows nothing plays no part: rays may have leapt to here. */
    const ints clear_before = ((v->before < look->first_value) & (v->here < look->first_value))
        | ((v->before >= look->last_value) & (v->here >= look->last_value));
    const floats to_front = choose(clear_before, (floats)(0.0f), 0.5f * (v->before - v->here));
    const floats to_back = 0.5f * (v->after - v->here);
    const floats least = lesser(lesser(to_front, to_back), (floats)(0.0f));
    const floats most = greater(greater(to_front, to_back), (floats)(0.0f));
    const floats slope = to_back - to_front, bend = to_back + to_front;
    const ints may_be_steep = counts & (v->here + most >= look->first_value) & (v->here + least < look->last_value)
        & ((most - least > look->narrow) | (opacity > DENSE));
    if (!ANY_LANE(may_be_steep))
        return opacity;
    const floats change = (floats)(GATHER(float, look->changes, find_node(v->here + most)))
        - (floats)(GATHER(float, look->changes, find_node(v->here + least)));
    const ints steep = may_be_steep & ((change > STEEP) | (opacity > DENSE));
    if (!ANY_LANE(steep))
        return opacity;
    floats clear = 1.0f, seen_at = 0.0f, seen_value = 0.0f;
    for (int part = 0; part < PARTS; ++part) {
        const float at = ((float)part + 0.5f) / (float)PARTS - 0.5f;
        const floats to_end = at < 0.0f ? v->reach * to_front : 2.0f * to_back, zero = 0.0f;
        const floats rise = lesser(greater(at * (slope + at * bend), lesser(to_end, zero)), greater(to_end, zero));
        const floats part_value = v->here + rise;
        const floats next = clear * (floats)(GATHER(float, look->clears, find_node(part_value)));
        seen_at += (clear - next) * at;
        seen_value += (clear - next) * part_value;
        clear = next;
    }
    const floats whole = 1.0f - clear;
    const floats share = 1.0f / greater(whole, (floats)(1e-6f));
    *shift = choose(steep, seen_at * share, *shift);
    *value = choose(steep, seen_value * share, *value);
    return choose(steep, whole, opacity);
}
#else
typedef struct {
    floats here;
} segment_values;

static inline floats find_steep_opacity(
    const looks *look, const segment_values *v, const ints counts, const floats opacity, floats *shift, floats *value)
{
    *shift = 0.0f;
    *value = v->here;
    return opacity;
}
#endif

#endif
