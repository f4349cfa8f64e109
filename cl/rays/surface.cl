/* Surfaces without a mesh: the first place of each ray where the field reaches the iso value, shaded.
 *
 * References: Phong 1975 (shading); Whitted 1980, "An improved illumination model for shaded display" (shadow rays);
 * Parker et al. 1998, "Interactive ray tracing for isosurface rendering".  Rays leap over bricks that cannot reach the
 * iso value (see rays/leap.h).  The field is that of the closed mesh (see rays/closed_field.h).
 *
 * A work-item has LANES neighbouring rays.  They leap together, as in cl/rays/composite.cl; where the level may be
 * reached, each continues alone, takes LANES samples along its way at a time and searches the first that is inside.
 *
 * -D UNEVEN   uneven slices
 * -D LABELS   labels with colours and opacities: a ray continues through translucent labels
 * -D OPENNESS hollows are darker, see rays/openness.h */
#include "rays/hit.h"
#include "rays/openness.h"
#include "rays/ray_state.h"
#include "rays/surface_lines.h"
#include "rays/view.h"
#ifdef LABELS
#include "rays/surface_labels.h"
#endif

#define OPAQUE 0.99f /* nothing behind can be seen */
#define OUT (-1.0f) /* in place of the label that a ray passes through */

/* LPS gradient of differences per index step in slice k.  Layers beyond the ends are as thick as those at the ends. */
static inline float3 to_lps(const scene *s, __global const float4 *view, const float4 step, const int k)
{
#ifdef UNEVEN
    __global const float4 *rows = s->stack.slices + 4 * clamp(k, 0, s->stack.nk - 1) + 1;
#else
    __global const float4 *rows = view + VIEW_NORMAL_X;
#endif
    return (float3)(dot4(rows[0], step), dot4(rows[1], step), dot4(rows[2], step));
}

/* LPS gradient at a place in field coordinates. */
static inline float3 find_gradient(const scene *s, __global const float4 *view, const float4 place)
{
    float4 below, above;
    const float3 at = index_of(s, place);
    const float share = find_closed_differences(&s->field, at, &below, &above);
#ifdef UNEVEN
    const int k = clamp((int)floor(at.z), -1, (int)s->field.inner.last.z);
    return (1.0f - share) * to_lps(s, view, below, k) + share * to_lps(s, view, above, k + 1);
#else
    return to_lps(s, view, below + share * (above - below), 0);
#endif
}

/* Normal of a cap: of the clip plane that a ray comes in through where it begins inside, or against its direction where
 * it begins at a camera in there. */
static inline float3 find_cap(
    __global const float4 *view, __global const float4 *normals, const uint planes,
    const int perspective, const ray *r)
{
    float latest = perspective ? -r->offset : -MAXFLOAT;
    float3 normal = -r->direction;
    for (uint plane = 0; plane < planes; ++plane) {
        const float4 side = view[VIEW_PLANES + plane];
        const float at = side.x * r->origin.x + side.y * r->origin.y + side.z * r->origin.z - side.w;
        const float rate = side.x * r->step.x + side.y * r->step.y + side.z * r->step.z;
        if (rate >= 1e-12f && -at / rate > latest) {
            latest = -at / rate;
            normal = normals[plane].xyz;
        }
    }
    return normal;
}

/* The way from a place to the fixed light: samples from a ray step on, as far as anything can be inside.  Returns how
 * many. */
static inline int start_to_light(
    __global const float4 *view, const uint planes, const float4 place, const float4 light_step,
    const float ray_step, line *to_light)
{
    ray r;
    r.origin = place;
    r.step = light_step;
    float t_in = 0.0f, t_out = MAXFLOAT;
    clip_to_box(&r, view[VIEW_FOCUS_LOW], view[VIEW_FOCUS_HIGH], &t_in, &t_out);
    for (uint plane = 0; plane < planes; ++plane) {
        const float4 side = view[VIEW_PLANES + plane];
        const float at = side.x * place.x + side.y * place.y + side.z * place.z - side.w;
        const float rate = side.x * light_step.x + side.y * light_step.y + side.z * light_step.z;
        t_out = rate < -1e-12f ? min(t_out, -at / rate) : t_out;
    }
    to_light->start = place + ray_step * light_step;
    to_light->stride = ray_step * light_step;
    to_light->last = (t_out - ray_step) / ray_step;
    return to_light->last >= 0.0f ? (int)ceil(to_light->last) + 1 : 0;
}

/* Numbers of the samples on a line within a slab; what one slab ends with, the next begins with. */
static inline void clip_to_slab(const line *along, const float slab_low, const float slab_high, int *n, int *end)
{
    const float rate = along->stride.z;
    if (fabs(rate) < 1e-12f) {
        *end = along->start.z >= slab_low && along->start.z < slab_high ? *end : 0;
        return;
    }
    const float at_low = clamp((slab_low - along->start.z) / rate, -1e9f, 1e9f);
    const float at_high = clamp((slab_high - along->start.z) / rate, -1e9f, 1e9f);
    *n = max(*n, rate > 0.0f ? (int)ceil(at_low) : (int)floor(at_high) + 1);
    *end = min(*end, rate > 0.0f ? (int)ceil(at_high) : (int)floor(at_low) + 1);
}

/* A hit of a ray. */
typedef struct {
    float4 place;
    float3 gradient; /* LPS, of any length */
    float number; /* of the sample, or between it and the one before */
    uint label;
    int exists;
} hit;

/* Sources of light and colours. */
typedef struct {
    __global const float4 *view, *normals;
    __global const float *highlights;
    uint planes;
    int perspective;
    float4 color, light_step, cue;
    float ray_step;
} looks;

/* Samples of a ray through the volume; *n is the first one to be looked at, the return value the end of them. */
static inline int start_line(
    const ray *r, const float ray_step, const float slab_low, const float slab_high, line *along, int *n)
{
    int end = 0;
    *n = 0;
    along->start = along->stride = (float4)(0.0f);
    along->last = 0.0f;
    if (r->t_out > r->t_in && r->focus_out > r->focus_in) {
        along->start = r->origin + r->t_in * r->step;
        along->stride = ray_step * r->step;
        along->last = (r->t_out - r->t_in) / ray_step;
        *n = max((int)floor((r->focus_in - r->t_in) / ray_step), 0);
        end = min((int)ceil((r->focus_out - r->t_in) / ray_step), (int)ceil(along->last)) + 1;
        clip_to_slab(along, slab_low, slab_high, n, &end);
    }
    return end;
}

/* Set the place where a ray meets the surface: between sample n, which is inside, and the one before. */
static inline void find_hit(
    const scene *s, const looks *look, const ray *r, const line *along, const int n, hit *h)
{
    h->exists = 1;
    h->number = n > 0 ? find_crossing(s, along, n) : 0.0f;
    h->place = place_on(along, h->number);
    h->gradient = n > 0 ? find_gradient(s, look->view, h->place)
                        : find_cap(look->view, look->normals, look->planes, look->perspective, r);
}

/* Find where the light of each hit is blocked: `to_light` stops there. */
static inline void follow_light(const scene *s, const looks *look, const hit *hits, bundle *to_light)
{
    to_light->last_counts = look->planes > 0;
    for (int lane = 0; lane < LANES; ++lane) {
        line *way = to_light->lines + lane;
        way->start = way->stride = (float4)(0.0f);
        to_light->numbers[lane] = to_light->ends[lane] = 0.0f;
        if (hits[lane].exists)
            to_light->ends[lane] = (float)start_to_light(
                look->view, look->planes, hits[lane].place, look->light_step, look->ray_step, way);
    }
    find_inside(s, to_light);
}

/* Blend a hit of colour rgb, of which `light` of the fixed light is lit, over what the ray has seen; `open` of all
 * light reaches it. */
static inline void add_hit(
    const looks *look, const hit *h, const ray *r, const line *along, float3 rgb, const float opacity,
    const float light, const float open, ray_state *seen)
{
    const float t = r->t_in + min(h->number, along->last) * look->ray_step;
    const float3 dark = rgb * look->view[VIEW_PHONG].x;
    rgb = dark + light * (shade(look->view, look->highlights, rgb, h->gradient, r->direction) - dark);
    rgb *= open * (1.0f - look->cue.z * clamp((t + r->offset - look->cue.x) * look->cue.y, 0.0f, 1.0f));
    const float weight = (1.0f - seen->color.w) * opacity;
    seen->color.xyz += weight * rgb;
    seen->color.w += weight;
    seen->sum += weight * t;
    if (seen->first_hit == NO_HIT && seen->color.w > FIRST_SEEN)
        seen->first_hit = t;
}

/* Of what colour and how opaque a surface is, and which part of the fixed light falls on it. */
typedef struct {
    float3 rgb;
    float opacity, light;
} hit_look;

/* In each variant:
 *
 *      pass_label    continue a ray through the label that it is in, if it is in one.  Entering another label is a hit.
 *                    Returns whether the ray has more samples
 *      find_look     what a hit looks like, or with `on_surface` one where the ray comes in from outside; the light is
 *                    blocked at sample `blocked` of the line to it, or with `blocked` = `end` nowhere.  The ray goes on
 *                    in the label that was hit */
#ifdef LABELS
typedef struct {
    __global const LABEL *labels;
    __global const int4 *near;
    int offsets;
    __global const float4 *colors;
} label_source;

#define LABEL_PARAMETERS \
    , __global const LABEL *restrict labels, __global const int4 *restrict near, const int offsets, \
        __global const float4 *restrict label_colors
#define LABEL_SOURCE { labels, near, offsets, label_colors }

static inline int pass_label(
    const scene *s, const label_source *source, const looks *look, const line *along, float *number, const float end,
    ray_state *seen, hit *h)
{
    if (seen->label == OUT)
        return 1;
    uint label = 0;
    const int n = leave_label(s, source->labels, along, (int)*number, (int)end, (uint)seen->label, &label);
    *number = (float)n;
    if (n >= (int)end)
        return 0;
    seen->label = label == 0 ? OUT : seen->label;
    h->exists = label != 0;
    h->label = label;
    h->number = (float)n;
    h->place = place_on(along, (float)n);
    if (h->exists) {
        const float3 at = index_of(s, h->place);
        const int k = clamp((int)floor(at.z + 0.5f), 0, (int)s->field.inner.last.z);
        const float4 differences = find_label_differences(source->labels, &s->field.inner, at, label);
        h->gradient = to_lps(s, look->view, differences, k);
    }
    return 1;
}

static inline hit_look find_look(
    const scene *s, const label_source *source, const looks *look, const int on_surface, const line *to_light,
    const float blocked, const float end, hit *h, ray_state *seen)
{
    if (on_surface)
        h->label = find_surface_label(s, source->labels, source->near, source->offsets, h->place);
    float light = 1.0f;
    if (blocked < end)
        light = let_light_through(
            s, source->labels, source->near, source->offsets, source->colors, to_light, (int)blocked, (int)end);
    seen->label = (float)h->label;
    const float4 color = source->colors[h->label];
    const hit_look seen_here = { tint(look->color.xyz, color, 1.0f), color.w, light };
    return seen_here;
}
#else
typedef struct {
    int unused;
} label_source;

#define LABEL_PARAMETERS
#define LABEL_SOURCE { 0 }

static inline int pass_label(
    const scene *s, const label_source *source, const looks *look, const line *along, float *number, const float end,
    ray_state *seen, hit *h)
{
    return 1;
}

static inline hit_look find_look(
    const scene *s, const label_source *source, const looks *look, const int on_surface, const line *to_light,
    const float blocked, const float end, hit *h, ray_state *seen)
{
    const hit_look seen_here = { look->color.xyz, 1.0f, blocked < end ? 0.0f : 1.0f };
    return seen_here;
}
#endif

/* Parameters  voxels   in   (slices, nj, ni)
 *             leaps    in   (bk, bj, bi) Chebyshev distance in bricks to the nearest one that reaches the
 *                           level, 0 where this one does
 *             view     in   see rays/view.h; the box goes one index step beyond the outermost voxel centres
 *             normals  in   (planes) unit normals of the clip planes, LPS
 *             labels   in   (slices, nj, ni), label_colors (numbers) in: only with LABELS, see rays/label_color.h
 *             near     in   (offsets) only with LABELS: see include/label_owner.h
 *             highlights in (HIGHLIGHTS) see rays/shade.h
 *             states   in/out  (height, width, 2) float4: see rays/ray_state.h; the label may be OUT
 *             image    out  (height, width) rgba
 *             depths means  out  (height, width) first hit and expected depth, mm; NaN where nothing is hit
 *             background    rgb, and 1 where it fills what the rays leave
 *             last_place    indices of the volume's last voxel centres;  slope: see find_pace()
 *             ni nj    of the buffer; first_k end_k: slices in the buffer; slab_low slab_high: samples whose third
 *                      field coordinate is from slab_low to below slab_high are this slab's
 *             level outside   where the surface lies; value around the volume
 *             color    rgb of the surface
 *             light_step   field coordinates per mm towards the fixed light; w: 1 with shadows, else 0
 *             cue      x: depth that is at full brightness, mm; y: 1 / mm from there to where it ends;
 *                      z: share of the brightness that is lost there
 *             stage    FIRST_SLAB and LAST_SLAB, see rays/view.h
 *             with OPENNESS the grid of rays/openness.h
 *             with UNEVEN the table of slices, see rays/stack.h
 * Launch      global = tiles * 64 / LANES rounded up by the host, any local
 * Assumes     the buffer reaches two slices beyond the slab, and steps are one at most; with
 *             shadows it is the whole volume
 * Guarantees  every pixel of image and depths is written with the last slab */
__kernel void trace_surface(
    __global const VOXEL *restrict voxels, __global const uchar *restrict leaps, __global const float4 *restrict view,
    __global const float4 *restrict normals,
    __global const float *restrict highlights, __global float4 *restrict states, __global uchar4 *restrict image,
    __global float *restrict depths, __global float *restrict means, const float4 background,
    const float4 last_place, const float4 slope, const int ni, const int nj, const int first_k,
    const int end_k, const float slab_low, const float slab_high, const int bi, const int bj, const int bk,
    const int cells_k,
    const float level, const float outside, const float4 color, const float4 light_step, const float4 cue,
    const uint width, const uint height, const uint planes, const int perspective, const int stage,
    const uint queues LABEL_PARAMETERS OPENNESS_PARAMETERS STACK_PARAMETERS)
{
    const uint first_pixel = (uint)get_global_id(0) * LANES;
    const field inner = { voxels, ni, nj, first_k, end_k, last_place };
    const closed_field f = { inner, level, outside };
    const leap_map map = { leaps, bi, bj, bk, cells_k };
    const slice_stack stack = STACK_TABLE;
    const scene s = { f, map, stack, slope };
    const label_source source = LABEL_SOURCE;
    const open_grid grid = OPENNESS_GRID;
    const looks look = { view, normals, highlights, planes, perspective, color, light_step, cue, view[VIEW_NEAR].y };
    ray rays[LANES];
    bundle all, to_light;
    hit hits[LANES];
    ray_state sights[LANES];
    float ends[LANES];
    all.last_counts = planes > 0;
    for (int lane = 0; lane < LANES; ++lane) {
        const int2 pixel = find_pixel(first_pixel + lane, width, height, queues);
        sights[lane].color = (float4)(0.0f);
        sights[lane].first_hit = NO_HIT;
        sights[lane].sum = 0.0f;
        sights[lane].label = OUT;
        int n = 0, end = 0;
        start_ray(view, convert_float2(pixel), planes, perspective, rays + lane);
        end = start_line(rays + lane, look.ray_step, slab_low, slab_high, all.lines + lane, &n);
        if (pixel.x >= (int)width || pixel.y >= (int)height)
            end = 0;
        else if (!(stage & FIRST_SLAB))
            load_state(states, (size_t)pixel.y * width + (size_t)pixel.x, sights + lane);
        all.numbers[lane] = (float)n;
        ends[lane] = (float)end;
    }
    for (;;) {
        int active = 0;
        for (int lane = 0; lane < LANES; ++lane) {
            int open = all.numbers[lane] < ends[lane] && sights[lane].color.w < OPAQUE;
            hits[lane].exists = 0;
            if (open)
                open = pass_label(&s, &source, &look, all.lines + lane, all.numbers + lane, ends[lane], sights + lane,
                    hits + lane);
            all.ends[lane] = open && !hits[lane].exists ? ends[lane] : -1.0f;
            active |= open;
        }
        if (!active)
            break;
        find_inside(&s, &all);
        for (int lane = 0; lane < LANES; ++lane)
            if (all.numbers[lane] < all.ends[lane])
                find_hit(&s, &look, rays + lane, all.lines + lane, (int)all.numbers[lane], hits + lane);
        if (light_step.w > 0.0f)
            follow_light(&s, &look, hits, &to_light);
        for (int lane = 0; lane < LANES; ++lane)
            if (hits[lane].exists) {
                const float end = light_step.w > 0.0f ? to_light.ends[lane] : 0.0f;
                const float blocked = light_step.w > 0.0f ? to_light.numbers[lane] : 0.0f;
                const hit_look seen = find_look(&s, &source, &look, all.ends[lane] >= 0.0f, to_light.lines + lane,
                    blocked, end, hits + lane, sights + lane);
                const float3 at = index_of(&s, hits[lane].place);
                const float open = read_openness(&grid, (float4)(at, 0.0f));
                add_hit(&look, hits + lane, rays + lane, all.lines + lane, seen.rgb, seen.opacity, seen.light, open,
                    sights + lane);
                all.numbers[lane] += 1.0f;
            }
    }
    for (int lane = 0; lane < LANES; ++lane) {
        const int2 pixel = find_pixel(first_pixel + lane, width, height, queues);
        const size_t at_pixel = (size_t)pixel.y * width + (size_t)pixel.x;
        if (pixel.x < (int)width && pixel.y < (int)height)
            store_state(sights + lane, rays[lane].offset, stage, at_pixel, states, image, depths, means, background);
    }
}
