/* The rays of a picture, and where they cross the volume.
 *
 * The host gives a table of float4, `view`, with one entry for each name below.  Field coordinates are voxel indices
 * (i, j, k); with -D UNEVEN they are (i, j) in the plane of slice 0 and the height over it in mm.  Both are affine in
 * LPS mm, so rays and clip planes are straight in them. */
#ifndef CLRECON_VIEW_H
#define CLRECON_VIEW_H

#define VIEW_ORIGIN 0 /* where the ray of pixel (0, 0) begins, field coordinates; w: see VIEW_NEAR */
#define VIEW_ORIGIN_X 1 /* and what a pixel to the right and one further down add */
#define VIEW_ORIGIN_Y 2
#define VIEW_STEP 3 /* field coordinates per mm along the ray of pixel (0, 0), before it is normalised */
#define VIEW_STEP_X 4
#define VIEW_STEP_Y 5
#define VIEW_DIRECTION 6 /* the same direction in LPS */
#define VIEW_DIRECTION_X 7
#define VIEW_DIRECTION_Y 8
#define VIEW_BOX_LOW 9 /* the box of the volume, field coordinates */
#define VIEW_BOX_HIGH 10
#define VIEW_FOCUS_LOW 11 /* the part of it that can show at all */
#define VIEW_FOCUS_HIGH 12
#define VIEW_NORMAL_X 13 /* rows of the matrix from differences per index step to LPS gradients per mm */
#define VIEW_NORMAL_Y 14
#define VIEW_NORMAL_Z 15
#define VIEW_LIGHT 16 /* xyz: LPS direction to a light that stands still; w: 1, or 0 for a light at the camera */
#define VIEW_PHONG 17 /* ambient, diffuse, specular, power of the highlight */
#define VIEW_NEAR 18 /* x: mm along an unnormalised direction from the camera to VIEW_ORIGIN; y: ray step, mm; z: square of Lighting.soft_gradient */
#define VIEW_PLANES 19 /* clip planes: kept is where xyz . field coordinates >= w */

#define TILE 8 /* work-items go through the picture in tiles of 8 x 8 pixels */

#define FIRST_SLAB 1 /* a picture begins with this slab of slices */
#define LAST_SLAB 2 /* and ends with it */

/* Picture of premultiplied `color` before `background`, whose w is 1, or 0 for none. */
static inline uchar4 finish_color(const float4 color, const float4 background)
{
    const float opacity = color.w + (1.0f - color.w) * background.w;
    const float3 rgb = color.xyz + (1.0f - color.w) * background.w * background.xyz;
    const float4 straight = opacity > 0.0f ? (float4)(rgb / opacity, opacity) : (float4)(0.0f);
    return convert_uchar4_sat_rte(255.0f * straight);
}

/* A ray: field coordinates at distance t mm from its origin are origin + t * step.  It crosses the box and what the
 * clip planes leave of it from t_in to t_out, nothing where t_out <= t_in.  Within the focus: focus_in to focus_out. */
typedef struct {
    float4 origin, step;
    float3 direction; /* unit, LPS */
    float offset; /* mm from the camera to the origin */
    float t_in, t_out, focus_in, focus_out;
} ray;

/* Tile of pixel `index` in the order of tiles.  That order has `queues` parts, and part q holds tiles q, q + queues,
 * q + 2 queues ...: CPU drivers cut a launch into as many equal parts as there are cores. */
static inline uint find_tile(const uint index, const uint width, const uint height, const uint queues)
{
    const uint tiles = (width + TILE - 1) / TILE * ((height + TILE - 1) / TILE);
    const uint share = (tiles + queues - 1) / queues, place = index / (TILE * TILE);
    /* Work-items beyond the last tile have a pixel below the picture: none is done twice. */
    return place < share * queues ? min(place % share * queues + place / share, tiles) : tiles;
}

/* Pixel `index` in the same order. */
static inline int2 find_pixel(const uint index, const uint width, const uint height, const uint queues)
{
    const uint columns = (width + TILE - 1) / TILE, tile = find_tile(index, width, height, queues);
    const uint pixel = index % (TILE * TILE);
    return (int2)((int)(tile % columns * TILE + pixel % TILE), (int)(tile / columns * TILE + pixel / TILE));
}

static inline void clip_to_box(const ray *r, const float4 low, const float4 high, float *t_in, float *t_out)
{
    /* A ray along a face neither divides by zero nor gets lost. */
    const float4 step = select(r->step, (float4)(1e-12f), fabs(r->step) < (float4)(1e-12f));
    const float4 to_low = (low - r->origin) / step, to_high = (high - r->origin) / step;
    const float4 enter = min(to_low, to_high), leave = max(to_low, to_high);
    *t_in = max(*t_in, max(max(enter.x, enter.y), enter.z));
    *t_out = min(*t_out, min(min(leave.x, leave.y), leave.z));
}

/* Set up the ray of pixel (x, y) with its way through the box; perspective rays begin at the camera. */
static inline void start_ray(
    __global const float4 *view, const float2 pixel, const uint planes, const int perspective, ray *r)
{
    const float x = pixel.x, y = pixel.y;
    const float4 direction = view[VIEW_DIRECTION] + x * view[VIEW_DIRECTION_X] + y * view[VIEW_DIRECTION_Y];
    const float length_mm = sqrt(direction.x * direction.x + direction.y * direction.y + direction.z * direction.z);
    r->direction = direction.xyz / length_mm;
    r->origin = view[VIEW_ORIGIN] + x * view[VIEW_ORIGIN_X] + y * view[VIEW_ORIGIN_Y];
    r->step = (view[VIEW_STEP] + x * view[VIEW_STEP_X] + y * view[VIEW_STEP_Y]) / length_mm;
    r->offset = view[VIEW_NEAR].x * length_mm;
    r->t_in = perspective ? -r->offset : -MAXFLOAT;
    r->t_out = MAXFLOAT;
    clip_to_box(r, view[VIEW_BOX_LOW], view[VIEW_BOX_HIGH], &r->t_in, &r->t_out);
    for (uint plane = 0; plane < planes; ++plane) {
        const float4 side = view[VIEW_PLANES + plane];
        const float at = side.x * r->origin.x + side.y * r->origin.y + side.z * r->origin.z - side.w;
        const float rate = side.x * r->step.x + side.y * r->step.y + side.z * r->step.z;
        const float crossing = -at / (fabs(rate) < 1e-12f ? 1e-12f : rate);
        if (fabs(rate) < 1e-12f)
            r->t_out = at < 0.0f ? r->t_in : r->t_out;
        else if (rate > 0.0f)
            r->t_in = max(r->t_in, crossing);
        else
            r->t_out = min(r->t_out, crossing);
    }
    r->focus_in = r->t_in;
    r->focus_out = r->t_out;
    clip_to_box(r, view[VIEW_FOCUS_LOW], view[VIEW_FOCUS_HIGH], &r->focus_in, &r->focus_out);
}

#endif
