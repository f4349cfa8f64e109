/* Volume rendering: colours and opacities of a transfer function, blended from front to back along the rays.
 *
 * References: Levoy 1988, "Display of surfaces from volume data" (shading, opacity by gradient); Max 1995, "Optical
 * models for direct volume rendering" (opacity of a segment).  Rays leap over empty space by a map of Chebyshev
 * distances (Cohen and Sheffer 1994, "Proximity clouds") and of free bricks ahead.
 *
 * Where the transfer function is steep, segments are divided into parts, see steep_segments.h.  This is a separate
 * variant, because it needs the neighbouring samples of each segment, which cost time.
 *
 * A work-item has a packet of LANES neighbouring rays that advance together, sample by sample: they leap as far as all
 * of them may, and each decision holds for all of them.
 *
 * -D UNEVEN             uneven slices
 * -D GRADIENT_OPACITY   opacity times a function of the gradient's magnitude
 * -D TAKES_PARTS=1      steep segments in parts; steps are so short that values are nearly linear between samples;
 *                       default 0, samples alone
 * -D LABELS             labels with colours and opacities
 * -D OPENNESS           hollows are darker, see rays/openness.h
 * -D BETWEEN            only what lies between two depths of each pixel, see cl/rays/layers.cl */
#include "rays/between.h"
#include "rays/field.h"
#include "rays/inner_samples.h"
#include "rays/jitter.h"
#include "rays/label_color.h"
#include "rays/leap.h"
#include "rays/look_ahead.h"
#include "rays/openness.h"
#include "rays/phong.h"
#include "rays/ray_packet.h"
#include "rays/ray_state.h"
#include "rays/sample_run.h"
#include "rays/stack.h"
#include "rays/steep_segments.h"
#include "rays/view.h"

#define GRADIENT_NODES 256 /* of the table of factors by magnitude */
#define OPAQUE 0.99f /* nothing behind can be seen */
#define SAMPLES_A_LOOK 8 /* samples until a packet looks for empty space again */
#define SAMPLES_AHEAD 6.0f /* that their voxels are asked for */

/* State of the rays, see ray_state: t of the first hit is negative while there is none. */
typedef struct {
    floats red, green, blue, opacity, first_hit, sum;
} sights;

/* Its numbers lane by lane, as rows of an array. */
#define RED 0
#define GREEN 1
#define BLUE 2
#define OPACITY 3
#define FIRST_HIT 4
#define SUM 5
#define STATE_NUMBERS 6

/* Opacity over `times` as many steps.  Called only where it is needed: logarithms are slow on CPUs.  Opacity 1 stays 1,
 * however short the way. */
static inline floats stretch_opacity(const floats opacity, const floats times)
{
    const floats stretched = 1.0f - exp2(log2(greater(1.0f - opacity, (floats)(1e-30f))) * times);
    return choose(opacity < 1.0f, stretched, (floats)(1.0f));
}

/* Opacity over one ray step where the opacity of the unit distance has a factor. */
static inline floats weigh_opacity(const looks *look, const floats opacity, const floats factor)
{
    const floats whole = stretch_opacity(opacity, (floats)(look->steps_per_unit));
    return stretch_opacity(factor * whole, (floats)(1.0f / look->steps_per_unit));
}

/* In each variant:
 *
 *      weigh_by_label      opacity with that of the labels at sample `number`
 *      tint_by_label       colour with a share of that of the labels at a place
 *      weigh_by_gradient   opacity with the factor of the gradient (x, y, z) */
#ifdef LABELS
#define LABEL_PARAMETERS , __global const LABEL *restrict labels, __global const float4 *restrict label_colors
#define LABEL_TABLES labels, label_colors
static inline floats weigh_by_label(const field *f, const slice_stack *stack, const looks *look,
    const ray_lanes *course, const packet *rays, const floats number, const floats opacity)
{
    if (!ANY_LANE(opacity > 0.0f))
        return opacity;
    floats i, j, k;
    find_places(stack, course, rays, number, 1, &i, &j, &k);
    const floats factor = LABEL_CHANNEL(look->label_colors, find_labels(look->labels, f, i, j, k), 3);
    if (!ANY_LANE((factor < 1.0f) & (opacity > 0.0f)))
        return opacity;
    return choose(factor < 1.0f, weigh_opacity(look, opacity, factor), opacity);
}

static inline void tint_by_label(const field *f, const looks *look, const floats i, const floats j, const floats k,
    floats *red, floats *green, floats *blue)
{
    const ints label = find_labels(look->labels, f, i, j, k);
    const floats label_red = LABEL_CHANNEL(look->label_colors, label, 0);
    const floats tinted = choose(label_red < 0.0f, (floats)(0.0f), (floats)(LABEL_TINT));
    *red += tinted * (label_red - *red);
    *green += tinted * (LABEL_CHANNEL(look->label_colors, label, 1) - *green);
    *blue += tinted * (LABEL_CHANNEL(look->label_colors, label, 2) - *blue);
}
#else
#define LABEL_PARAMETERS
#define LABEL_TABLES 0, 0
static inline floats weigh_by_label(const field *f, const slice_stack *stack, const looks *look,
    const ray_lanes *course, const packet *rays, const floats number, const floats opacity)
{
    return opacity;
}

static inline void tint_by_label(const field *f, const looks *look, const floats i, const floats j, const floats k,
    floats *red, floats *green, floats *blue)
{
}
#endif

#ifdef GRADIENT_OPACITY
#define IS_WEIGHED 1
static inline floats weigh_by_gradient(
    const looks *look, const floats opacity, const floats x, const floats y, const floats z)
{
    const floats entry = lesser(sqrt(x * x + y * y + z * z) * look->factor_scale, (floats)(GRADIENT_NODES - 1));
    const ints at = lesser_int(to_ints(entry), (ints)(GRADIENT_NODES - 2));
    const floats low = (floats)(GATHER(float, look->factors, at));
    const floats high = (floats)(GATHER(float, look->factors + 1, at));
    const floats factor = low + (entry - to_floats(at)) * (high - low);
    return choose(opacity > 0.0f, weigh_opacity(look, opacity, factor), opacity);
}
#else
#define IS_WEIGHED 0
static inline floats weigh_by_gradient(
    const looks *look, const floats opacity, const floats x, const floats y, const floats z)
{
    return opacity;
}
#endif

/* Opacity over one ray step of segment n of each ray, whose light and colour are taken at `number`; 0 for lanes whose
 * segment does not count.  With `inner` the segments of all lanes count, lie within the volume with all voxels that
 * they need, and are not the last of their rays. */
static inline floats find_opacity(const field *f, const slice_stack *stack, const looks *look, const ray_lanes *course,
    const packet *rays, const float n, const int inner, const ints counts, const segment_values *v, floats *number,
    floats *value)
{
    floats shift;
    floats opacity = (floats)(GATHER(float, look->opacities, find_node(v->here)));
    opacity = find_steep_opacity(look, v, counts, opacity, &shift, value);
    *number = find_number(rays, look, n, inner, shift);
    if (!inner) {
        floats i, j, k;
        find_places(stack, course, rays, (floats)(n), 0, &i, &j, &k);
        const ints within = (k >= look->slab_low) & (k < look->slab_high) & (n >= rays->begin) & lie_in_slice(f, i, j);
        opacity = choose(within, opacity, (floats)(0.0f));
    }
    return weigh_by_label(f, stack, look, course, rays, *number, opacity);
}

/* Blend segment n of each ray where it has opacity; `value` and `opacity` are those at `number`.  Light comes from the
 * gradients of `smooth`. */
static inline void blend_samples(const field *f, const field *smooth, const slice_stack *stack, const looks *look, const ray_lanes *course,
    const packet *rays, const open_grid *grid, const float n, const int inner, const floats number,
    const floats value, floats opacity, sights *seen)
{
    floats i, j, k;
    find_places(stack, course, rays, number, 1, &i, &j, &k);
    floats share = 1.0f, highlight = 0.0f;
    if (look->shaded || IS_WEIGHED) {
        slopes s;
        floats x, y, z;
        /* In a loop, for fewer registers: gradients of the volume weigh the opacity, smoothed ones are lit. */
#pragma unroll 1
        for (int is_lit = !IS_WEIGHED; is_lit < 2; ++is_lit) {
            find_slopes(is_lit ? smooth : f, i, j, k, inner, &s);
            find_gradients(look->view, stack, &s, k, &x, &y, &z);
            if (!is_lit)
                opacity = weigh_by_gradient(look, opacity, x, y, z);
        }
        if (look->shaded)
            find_light(look->view, look->highlights, x, y, z, rays->toward_x, rays->toward_y, rays->toward_z, &share,
                &highlight);
    }
    const floats open = find_openness(grid, i, j, k);
    share *= open;
    highlight *= open;
    const floats t = rays->t_in + (number + rays->phase) * look->ray_step;
    const ints cut = (rays->last == n) & (opacity > 0.0f);
    if (ANY_LANE(cut))
        opacity = choose(cut, stretch_opacity(opacity, rays->rest / look->ray_step), opacity);
    const ints color = (ints)(GATHER(int, look->colors, find_node(value)));
    const floats unit = 1.0f / 1023.0f;
    floats red = to_floats(color >> 20) * unit, green = to_floats((color >> 10) & 1023) * unit;
    floats blue = to_floats(color & 1023) * unit;
    tint_by_label(f, look, i, j, k, &red, &green, &blue);
    const floats weight = (1.0f - seen->opacity) * opacity;
    seen->red += weight * lesser(red * share + highlight, (floats)(1.0f));
    seen->green += weight * lesser(green * share + highlight, (floats)(1.0f));
    seen->blue += weight * lesser(blue * share + highlight, (floats)(1.0f));
    seen->opacity += weight;
    seen->sum += weight * t;
    seen->first_hit = choose((seen->first_hit < 0.0f) & (seen->opacity > FIRST_SEEN), t, seen->first_hit);
}

/* Shorten the ways of rays to what lies between two depths.  The ends of a way stay finite. */
#ifdef BETWEEN
static inline void shorten_ways(const int2 first_pixel, const int2 size, ray_packet *way,
    __global const float *nearest, __global const float *farthest)
{
    float begin_of[LANES], end_of[LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        const int inside = first_pixel.x + lane < size.x && first_pixel.y < size.y;
        const size_t place = (size_t)first_pixel.y * (size_t)size.x + (size_t)(first_pixel.x + lane);
        begin_of[lane] = inside ? nearest[place] : 0.0f;
        end_of[lane] = inside ? farthest[place] : 0.0f;
    }
    const floats begin = load_lanes(begin_of) - way->offset, end = load_lanes(end_of) - way->offset;
    way->t_in = lesser(greater(way->t_in, begin), way->t_out);
    way->t_out = greater(lesser(way->t_out, end), way->t_in);
}
#else
static inline void shorten_ways(const int2 first_pixel, const int2 size, ray_packet *way) {}
#endif

/* Set up the rays of LANES pixels that are neighbours in a row; nothing shows before `entry`. */
static inline void start_rays(const field *f, const looks *look, const int2 first_pixel, const int2 size,
    const uint planes, const int perspective, const int jitter, const float entry, const float4 slope,
    ray_lanes *course, packet *rays BETWEEN_PARAMETERS)
{
    const float ray_step = look->ray_step;
    const floats x = (float)first_pixel.x + LANE_NUMBERS, y = (float)first_pixel.y;
    ray_packet way;
    start_packet(look->view, x, y, planes, perspective, &way);
    shorten_ways(first_pixel, size, &way BETWEEN_ARGUMENTS);
    rays->phase = 0.5f;
    if (jitter) {
        float phase_of[LANES];
        for (int lane = 0; lane < LANES; ++lane)
            phase_of[lane] = jitter_pixel((uint)(first_pixel.x + lane), (uint)first_pixel.y);
        rays->phase = load_lanes(phase_of);
    }
    lay_course(&way, way.t_in + rays->phase * ray_step, (floats)(ray_step), slope, course);
    rays->t_in = way.t_in;
    rays->offset = way.offset;
    rays->toward_x = way.toward_x;
    rays->toward_y = way.toward_y;
    rays->toward_z = way.toward_z;
    const floats span = way.t_out - way.t_in;
    const floats segments = choose(span > 0.0f, round_up(span / ray_step), (floats)(0.0f));
    rays->last = segments - 1.0f;
    rays->rest = span - rays->last * ray_step;
    rays->last_number = rays->last - rays->phase * (1.0f - rays->rest / ray_step);
    const floats enter = greater(way.focus_in, (floats)(entry));
    const ints some = (x < (float)size.x) & (y < (float)size.y) & (segments > 0.0f) & (way.focus_out > enter);
    /* The samples, or the segments in parts, around the first and the last place that can show; one more to round. */
    const float more = 1.0f + (float)BESIDE;
    const floats begin = round_up(greater((enter - way.t_in) / ray_step - rays->phase, (floats)(0.0f))) - more;
    const floats end = round_up((way.focus_out - way.t_in) / ray_step - rays->phase) + more;
    rays->begin = choose(some, greater(begin, (floats)(0.0f)), (floats)(MAXFLOAT));
    rays->end = choose(some, lesser(end, segments), (floats)(0.0f));
    find_inner(f, &way, way.t_in + rays->phase * ray_step, (floats)(ray_step), rays->last, look->slab_low,
        look->slab_high, &rays->inner_begin, &rays->inner_end);
    /* Rays that begin later than others count from there on. */
    rays->inner_begin = max(rays->inner_begin, -LEAST_LANE(-choose(some, rays->begin, (floats)(0.0f))));
}

/* The state that earlier slabs left. */
static inline void load_sights(__global const float4 *states, const int2 first_pixel, const int2 size, sights *seen)
{
    float lane_of[STATE_NUMBERS][LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        const int inside = first_pixel.x + lane < size.x && first_pixel.y < size.y;
        const size_t place = (size_t)first_pixel.y * (size_t)size.x + (size_t)(first_pixel.x + lane);
        const float4 color = inside ? states[2 * place] : (float4)(0.0f);
        const float4 rest = inside ? states[2 * place + 1] : (float4)(0.0f);
        lane_of[RED][lane] = color.x;
        lane_of[GREEN][lane] = color.y;
        lane_of[BLUE][lane] = color.z;
        lane_of[OPACITY][lane] = color.w;
        lane_of[FIRST_HIT][lane] = rest.x;
        lane_of[SUM][lane] = rest.y;
    }
    seen->red = load_lanes(lane_of[RED]);
    seen->green = load_lanes(lane_of[GREEN]);
    seen->blue = load_lanes(lane_of[BLUE]);
    seen->opacity = load_lanes(lane_of[OPACITY]);
    seen->first_hit = load_lanes(lane_of[FIRST_HIT]);
    seen->sum = load_lanes(lane_of[SUM]);
}

/* Parameters  voxels   in   (slices, nj, ni)
 *             smoothed in   the same shape: the field whose gradients are lit, see rays/smooth.cl; or `voxels`
 *             ways     in   (bk, bj, bi) distances to visible bricks, see rays/look_ahead.h
 *             colors opacities clears changes factors  in  (NODES) each, (GRADIENT_NODES), see looks
 *             highlights in (HIGHLIGHTS) see rays/shade.h
 *             entries  in   (tile rows, tile columns) t before which nothing is visible, MAXFLOAT where nothing is
 *             view     in   see rays/view.h
 *             states   in/out  (height, width, 2) float4: see rays/ray_state.h
 *             image    out  (height, width) rgba
 *             depths means  out  (height, width) first hit and expected depth, mm; NaN where nothing is hit
 *             background    rgb, and 1 where it fills what the rays leave
 *             last_place    indices of the volume's last voxel centres;  slope: see find_pace()
 *             ni nj    of the buffer; first_k end_k: slices in the buffer; slab_low slab_high: samples with
 *                      slab_low <= k < slab_high are this slab's
 *             bi bj bk bricks, cells_k of each along k
 *             has_dense  whether a step has more opacity than DENSE anywhere
 *             one_sided  whether the visible nodes are the first ones, or the last ones
 *             low scale first_shown last_shown narrow factor_scale steps_per_unit  see looks
 *             main_axis ahead eye aside   see main_way
 *             jitter   samples at random places of their segments
 *             stage    FIRST_SLAB and LAST_SLAB, see rays/view.h
 *             with BETWEEN nearest, farthest  in  (height, width) mm along the ray where the way begins and ends
 *             with LABELS those of the buffer's slices, and the table of rays/label_color.h
 *             with OPENNESS the grid of rays/openness.h
 *             with UNEVEN the table of slices, see rays/stack.h
 * Launch      global = tiles * 64 / LANES rounded up by the host, any local
 * Guarantees  every pixel of image, depths and means is written with the last slab */
__kernel void composite_rays(
    __global const VOXEL *restrict voxels, __global const VOXEL *restrict smoothed,
    __global const uchar *restrict ways, __global const int *restrict colors, __global const float *restrict opacities,
    __global const float *restrict clears, __global const float *restrict changes,
    __global const float *restrict factors, __global const float *restrict highlights,
    __global const float *restrict entries, __global const float4 *restrict view,
    __global float4 *restrict states, __global uchar4 *restrict image,
    __global float *restrict depths, __global float *restrict means, const float4 background, const float4 last_place,
    const float4 slope, const int ni, const int nj, const int first_k, const int end_k, const float slab_low,
    const float slab_high, const int bi, const int bj, const int bk, const int cells_k, const float low,
    const float scale, const int first_shown, const int last_shown, const float narrow,
    const int has_dense, const int one_sided, const float factor_scale,
    const float steps_per_unit, const uint width, const uint height, const uint planes, const int perspective,
    const int shaded, const int jitter, const int stage, const uint queues, const int main_axis, const int ahead,
    const float4 eye, const float aside
    BETWEEN_PARAMETERS LABEL_PARAMETERS OPENNESS_PARAMETERS STACK_PARAMETERS)
{
    const uint first_pixel = (uint)get_global_id(0) * LANES;
    const field f = { voxels, ni, nj, first_k, end_k, last_place };
    const field smooth = { smoothed, ni, nj, first_k, end_k, last_place };
    const open_grid grid = OPENNESS_GRID;
    const leap_map map = { ways, bi, bj, bk, cells_k };
    const main_way way = { main_axis, ahead, eye, aside };
    const slice_stack stack = STACK_TABLE;
    const float ray_step = view[VIEW_NEAR].y;
    /* Values beyond the first and the last node count as these. */
    const float first_value = first_shown > 0 ? (float)first_shown : -MAXFLOAT;
    const float last_value = last_shown < NODES - 1 ? (float)last_shown + 1.0f : MAXFLOAT;
    const looks look = { colors, opacities, clears, changes, narrow, highlights, factors, view, low, scale,
        factor_scale, steps_per_unit, ray_step, slab_low, slab_high, first_value, last_value, shaded,
        LABEL_TABLES };

    const uint tile = find_tile(first_pixel, width, height, queues);
    const uint tiles = (width + TILE - 1) / TILE * ((height + TILE - 1) / TILE);
    const float entry = tile < tiles ? entries[tile] : MAXFLOAT;
    if (entry == MAXFLOAT && stage == (FIRST_SLAB | LAST_SLAB)) {
        for (int lane = 0; lane < LANES; ++lane) {
            const int2 pixel = find_pixel(first_pixel + lane, width, height, queues);
            if (pixel.x < (int)width && pixel.y < (int)height) {
                const size_t place = (size_t)pixel.y * width + (size_t)pixel.x;
                image[place] = finish_color((float4)(0.0f), background);
                depths[place] = means[place] = NAN;
            }
        }
        return;
    }
    const int2 pixel_of_first = find_pixel(first_pixel, width, height, queues), size = { (int)width, (int)height };
    ray_lanes course;
    packet rays;
    start_rays(
        &f, &look, pixel_of_first, size, planes, perspective, jitter, entry, slope, &course, &rays BETWEEN_ARGUMENTS);
    sights seen;
    seen.red = seen.green = seen.blue = seen.opacity = seen.sum = 0.0f;
    seen.first_hit = -1.0f;
    if (!(stage & FIRST_SLAB))
        load_sights(states, pixel_of_first, size, &seen);
    float n = LEAST_LANE(rays.begin);
    floats end = choose(seen.opacity < OPAQUE, rays.end, (floats)(0.0f));
    int shows = 0; /* the samples before: then the next ones probably do too */
    sample_run run;
    forget_samples(&run);
    while (ANY_LANE(n < end)) {
        if (!shows) {
            /* The last sample of a ray lies before its place in the row. */
            brick_lanes bricks;
            const ints at
                = place_bricks(&map, &stack, &course, lesser((floats)(n), rays.last_number), first_k, &bricks);
            const ints seen_from_here = (ints)(GATHER(uchar, ways, at));
            bricks.distance = DISTANCE_OF(seen_from_here);
            if (!ANY_LANE((n < end) & (n >= rays.begin) & (bricks.distance == 0))) {
                const floats free = greater(count_to_faces(&map, &course, &bricks),
                    count_ahead(&map, &way, &course, &bricks, AHEAD_OF(seen_from_here)));
                const floats leap = greater(free, rays.begin - n);
                const float least = LEAST_LANE(choose(n < end, leap, (floats)(MAXFLOAT)));
                const int whole = (int)least;
                n += (float)max(whole + ((float)whole < least), 1);
                forget_samples(&run);
                continue;
            }
        }
        begin_samples(&f, &stack, &look, &course, &rays, one_sided, &n, &run);
        for (int part = 0; part < SAMPLES_A_LOOK && ANY_LANE(n < end); part += AT_ONCE) {
            floats value[AT_ONCE + 2 * BESIDE];
            const int inner = HAS_INNER && n - (float)BESIDE >= rays.inner_begin
                && n + (float)(AT_ONCE + BESIDE) <= rays.inner_end;
            if (inner)
                fetch_sample_early(&f, &course, n + SAMPLES_AHEAD, rays.inner_end);
            const ints may_show = take_samples(&f, &stack, &look, &course, &rays, n, inner, has_dense, value, &run);
            shows = ANY_LANE(may_show & (n < end));
            if (shows) {
                for (int sample = 0; sample < AT_ONCE; ++sample) {
                    /* A GPU would keep an array in memory for an index of run time: there the values move up. */
                    const int at = LANES == 1 ? 0 : sample;
                    const float segment = n + (float)sample;
                    const ints counts = segment < end;
                    if (!ANY_LANE(counts))
                        break;
                    const segment_values v = find_segment(&run, value, at, segment);
                    floats number, seen_value;
                    const floats opacity = find_opacity(
                        &f, &stack, &look, &course, &rays, segment, inner, counts, &v, &number, &seen_value);
                    const floats seen_here = choose(counts, opacity, (floats)(0.0f));
                    if (ANY_LANE(seen_here > 0.0f)) {
                        blend_samples(&f, &smooth, &stack, &look, &course, &rays, &grid, segment, inner, number, seen_value,
                            seen_here, &seen);
                        end = choose(seen.opacity < OPAQUE, end, (floats)(0.0f));
                    }
                    for (int next = 1; LANES == 1 && next < AT_ONCE + 2 * BESIDE; ++next)
                        value[next - 1] = value[next];
                }
            }
            n += (float)AT_ONCE;
        }
    }
    float out_of[STATE_NUMBERS][LANES], offset_of[LANES];
    store_lanes(seen.red, out_of[RED]);
    store_lanes(seen.green, out_of[GREEN]);
    store_lanes(seen.blue, out_of[BLUE]);
    store_lanes(seen.opacity, out_of[OPACITY]);
    store_lanes(seen.first_hit, out_of[FIRST_HIT]);
    store_lanes(seen.sum, out_of[SUM]);
    store_lanes(rays.offset, offset_of);
    for (int lane = 0; lane < LANES; ++lane) {
        const int2 pixel = find_pixel(first_pixel + lane, width, height, queues);
        if (pixel.x >= (int)width || pixel.y >= (int)height)
            continue;
        const size_t place = (size_t)pixel.y * width + (size_t)pixel.x;
        const float4 color
            = (float4)(out_of[RED][lane], out_of[GREEN][lane], out_of[BLUE][lane], out_of[OPACITY][lane]);
        const float first_hit = out_of[FIRST_HIT][lane], sum = out_of[SUM][lane];
        if (!(stage & LAST_SLAB)) {
            states[2 * place] = color;
            states[2 * place + 1] = (float4)(first_hit, sum, 0.0f, 0.0f);
            continue;
        }
        image[place] = finish_color(color, background);
        depths[place] = first_hit < 0.0f ? NAN : first_hit + offset_of[lane];
        means[place] = first_hit < 0.0f ? NAN : sum / color.w + offset_of[lane];
    }
}
