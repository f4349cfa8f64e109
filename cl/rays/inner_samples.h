/* Inner samples of a packet of rays: so far inside the volume that none needs clamping, see find_cells(). */
#ifndef CLRECON_INNER_SAMPLES_H
#define CLRECON_INNER_SAMPLES_H

#include "rays/field.h"
#include "rays/ray_packet.h"

/* Whether the way is long enough that finding the inner samples saves time. */
#if HAS_WINDOWS && !defined(UNEVEN)
#define HAS_INNER 1
#else
#define HAS_INNER 0
#endif

/* Ask for the voxels that the first lane needs at sample n of a packet, if that is before `end`. */
#if HAS_INNER
static inline void fetch_sample_early(const field *f, const ray_lanes *course, const float n, const float end)
{
    if (n < end)
        fetch_cell_early(f, course->start_i.s0 + n * course->stride_i.s0, course->start_j.s0 + n * course->stride_j.s0,
            course->start_k.s0 + n * course->stride_k.s0);
}
#else
static inline void fetch_sample_early(const field *f, const ray_lanes *course, const float n, const float end) {}
#endif

/* Voxels along one axis that rounding may move samples by: places are sums of terms as large as the rays' origins. */
static inline float find_slack(const floats origin, const float last)
{
    return 1e-3f + 2e-6f * (last - LEAST_LANE(-fabs(origin)));
}

/* Of samples n at t = first_t + n * step_t mm, 0 <= n <= last: those of all lanes from `least` to below `greatest` are
 * inner ones and have slab_low <= k < slab_high. */
static inline void find_inner(const field *f, const ray_packet *rays, const floats first_t, const floats step_t,
    const floats last, const float slab_low, const float slab_high, float *least, float *greatest)
{
    *least = MAXFLOAT;
    *greatest = 0.0f;
#if HAS_INNER
    const float4 slack = (float4)(find_slack(rays->origin_i, f->last.x), find_slack(rays->origin_j, f->last.y),
        find_slack(rays->origin_k, f->last.z), 0.0f);
    const float4 low = (float4)(1.0f, 1.0f, max((float)f->first_k + 1.0f, slab_low), 0.0f) + slack;
    const float4 high
        = (float4)((float)(f->ni - 2), (float)(f->nj - 2), min((float)f->end_k - 2.0f, slab_high), 0.0f) - slack;
    /* Few rows or slices, and slabs with few at an end, have no inner samples: their bounds are the wrong way round. */
    if (f->ni < WINDOW || !(low.x < high.x && low.y < high.y && low.z < high.z))
        return;
    floats t_in = rays->t_in, t_out = rays->t_out;
    clip_packet_to_box(rays, low, high, &t_in, &t_out);
    const floats from = choose(t_in < t_out, round_up((t_in - first_t) / step_t), (floats)(MAXFLOAT));
    *least = -LEAST_LANE(-greater(from, (floats)(0.0f)));
    *greatest = LEAST_LANE(lesser((t_out - first_t) / step_t, last));
#endif
}

#endif
