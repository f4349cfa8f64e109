/* What a picture keeps of each ray between slabs of slices, and what it shows of it after the last one.
 *
 *      states[2 * pixel]        premultiplied red, green, blue; opacity
 *      states[2 * pixel + 1]    t of the first hit; sum of w t; label that the ray passes through; - */
#ifndef CLRECON_RAY_STATE_H
#define CLRECON_RAY_STATE_H

#include "rays/view.h"

#define FIRST_SEEN (1.0f / 255.0f) /* opacity that makes a first hit */
#define NO_HIT (-MAXFLOAT)

typedef struct {
    float4 color; /* premultiplied */
    float first_hit, sum; /* t of the first hit; sum of t, weighted */
    float label;
} ray_state;

static inline void load_state(__global const float4 *states, const size_t pixel, ray_state *seen)
{
    const float4 rest = states[2 * pixel + 1];
    seen->color = states[2 * pixel];
    seen->first_hit = rest.x;
    seen->sum = rest.y;
    seen->label = rest.z;
}

/* Keep the state of a ray for the next slab; after the last slab, write its pixel. */
static inline void store_state(
    const ray_state *seen, const float offset, const int stage, const size_t pixel, __global float4 *states,
    __global uchar4 *image, __global float *depths, __global float *means, const float4 background)
{
    const float4 color = seen->color;
    if (!(stage & LAST_SLAB)) {
        states[2 * pixel] = color;
        states[2 * pixel + 1] = (float4)(seen->first_hit, seen->sum, seen->label, 0.0f);
        return;
    }
    image[pixel] = finish_color(color, background);
    const int is_missed = seen->first_hit == NO_HIT;
    depths[pixel] = is_missed ? NAN : seen->first_hit + offset;
    means[pixel] = is_missed ? NAN : seen->sum / color.w + offset;
}

#endif
