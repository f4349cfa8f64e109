/* Pictures of points: each a disc that faces the camera, the nearest one seen in each pixel.
 *
 * Reference: Zwicker, Pfister, van Baar, Gross 2001, "Surface splatting" (discs for points); Boucheny 2009, "Interactive
 * scientific visualization of large datasets" (eye-dome lighting, for points without normals).
 *
 *          a row of pixels            disc A (number 4)     disc B (number 7), nearer
 *                                     . . A A A . .         . . . B B . .
 *      keys      least of all depths  . . a a b b .         as bits that are ordered as the depths are
 *      numbers   least of those       . . 4 4 7 7 .         of equal depth the point with the lowest number
 *
 * Passes
 *   1. clear_splats    no depth and no number anywhere
 *   2. splat_depths    every point brings its depth to the pixels of its disc: atomic minimum
 *   3. splat_numbers   every point whose depth a pixel has brings its number: atomic minimum
 *   4. shade_splats    colour, light and depth of the point of each pixel
 *
 * Minima do not depend on the order of the work-items.  What decides which pixels a disc covers, and at which depth, are
 * products and sums in one order without contraction: the same point is seen in a pixel on every device.
 *
 * A parallel camera sees a disc of radius r as a disc of that radius in mm.  A perspective one sees it at depth z across
 * the view: a pixel's ray passes there z * d mm beside the middle of the view, d being the pixel's tangent. */
#include "rays/eye.h"
#include "rays/shade.h"
#include "rays/view.h"

#define LEAST_PIXELS 0.7072f /* least radius of a disc: it reaches the centre of the pixel that its point falls in */
#define MOST_PIXELS 128.0f /* and its largest */

#define UNSHADED_POINTS 0 /* how points are shaded */
#define SHADED_BY_NORMALS 1
#define SHADED_BY_DEPTHS 2

#define STEEPEST 8.0f /* slope beyond which a neighbour does not darken a pixel any more */
#define DARKENING 0.5f /* light that is left at a mean slope s towards the camera: exp(-DARKENING s) */

/* A point as the camera sees it: mm to the right and up, and the depth across the view.  Its disc has radius `reach`;
 * mm at its depth are `scale` times those of the pixels' table.  It covers nothing where `reach` is below 0. */
typedef struct {
    float x, y, depth, scale, reach;
    int left, right, top, bottom; /* pixels that hold the disc, the last ones excluded */
} disc;

static inline disc place_disc(__global const float *points, const size_t point, __global const float4 *view,
    const float radius, const int width, const int height)
{
    const float4 right = view[EYE_RIGHT], up = view[EYE_UP], forward = view[EYE_FORWARD];
    const float4 pixel = view[EYE_PIXEL];
    const float x = points[3 * point], y = points[3 * point + 1], z = points[3 * point + 2];
    disc d;
    d.x = ((right.x * x + right.y * y) + right.z * z) + right.w;
    d.y = ((up.x * x + up.y * y) + up.z * z) + up.w;
    d.depth = ((forward.x * x + forward.y * y) + forward.z * z) + forward.w;
    d.scale = pixel.w > 0.0f ? d.depth : 1.0f;
    const float side = pixel.x * d.scale;
    d.reach = clamp(radius, LEAST_PIXELS * side, MOST_PIXELS * side);
    if (pixel.w > 0.0f && d.depth < NEAREST_MM) {
        d.reach = -1.0f;
        d.left = d.right = d.top = d.bottom = 0;
        return d;
    }
    /* A pixel more on each side, whatever the rounding of these quotients. */
    const float margin = d.reach / side + 1.5f, column = d.x / side + pixel.y, row = pixel.z - d.y / side;
    d.left = (int)clamp(column - margin, 0.0f, (float)width);
    d.right = (int)clamp(column + margin + 1.0f, 0.0f, (float)width);
    d.top = (int)clamp(row - margin, 0.0f, (float)height);
    d.bottom = (int)clamp(row + margin + 1.0f, 0.0f, (float)height);
    return d;
}

/* True where the centre of a pixel lies on the disc. */
static inline int covers(const disc *d, const float4 pixel, const int column, const int row)
{
    const float to_x = d->x - d->scale * ((((float)column + 0.5f) - pixel.y) * pixel.x);
    const float to_y = d->y - d->scale * ((pixel.z - ((float)row + 0.5f)) * pixel.x);
    return to_x * to_x + to_y * to_y <= d->reach * d->reach;
}

/* Parameters  keys, numbers  out  (pixels) EMPTY
 *             pixels
 * Launch      global = pixels rounded up by the host, any local
 * Guarantees  every entry is written */
__kernel void clear_splats(__global uint *restrict keys, __global uint *restrict numbers, const uint pixels)
{
    const uint pixel = get_global_id(0);
    if (pixel >= pixels)
        return;
    keys[pixel] = EMPTY;
    numbers[pixel] = EMPTY;
}

/* Parameters  points  in      (count, 3) mm, LPS from the base of the view's table
 *             view    in      (6) float4, see rays/eye.h
 *             keys    in/out  (height, width) least key of a depth so far
 *             radius  of the discs, mm
 *             count   points
 * Launch      global = count rounded up by the host, any local
 * Assumes     points are finite
 * Guarantees  keys do not depend on the order of the points */
__kernel void splat_depths(
    __global const float *restrict points, __global const float4 *restrict view, __global uint *keys,
    const float radius, const uint count, const int width, const int height)
{
    const size_t point = get_global_id(0);
    if (point >= count)
        return;
    const disc d = place_disc(points, point, view, radius, width, height);
    const float4 pixel = view[EYE_PIXEL];
    const uint key = key_of(d.depth);
    for (int row = d.top; row < d.bottom; ++row)
        for (int column = d.left; column < d.right; ++column)
            if (covers(&d, pixel, column, row))
                atomic_min(keys + (size_t)row * (size_t)width + (size_t)column, key);
}

/* Parameters  points, view, radius, count  as in splat_depths
 *             keys     in      (height, width) of all points
 *             numbers  in/out  (height, width) least number of a point at that depth so far
 *             first    number of the first of these points
 * Launch      as splat_depths
 * Assumes     numbers of points are below EMPTY
 * Guarantees  numbers do not depend on the order of the points */
__kernel void splat_numbers(
    __global const float *restrict points, __global const float4 *restrict view, __global const uint *restrict keys,
    __global uint *numbers, const float radius, const uint first, const uint count, const int width, const int height)
{
    const size_t point = get_global_id(0);
    if (point >= count)
        return;
    const disc d = place_disc(points, point, view, radius, width, height);
    const float4 pixel = view[EYE_PIXEL];
    const uint key = key_of(d.depth);
    for (int row = d.top; row < d.bottom; ++row)
        for (int column = d.left; column < d.right; ++column) {
            const size_t at = (size_t)row * (size_t)width + (size_t)column;
            if (keys[at] == key && covers(&d, pixel, column, row))
                atomic_min(numbers + at, first + (uint)point);
        }
}

/* Light that is left of a place whose surroundings are nearer than it is: pixels around it at distance `apart`. */
static inline float find_eye_dome(__global const uint *keys, const float4 pixel, const float depth, const int column,
    const int row, const int apart, const int width, const int height)
{
    const float way = (float)apart * pixel.x * (pixel.w > 0.0f ? depth : 1.0f);
    float sum = 0.0f;
    for (int down = -1; down <= 1; ++down)
        for (int aside = -1; aside <= 1; ++aside) {
            const int x = column + aside * apart, y = row + down * apart;
            if ((aside == 0 && down == 0) || x < 0 || x >= width || y < 0 || y >= height)
                continue;
            const uint key = keys[(size_t)y * (size_t)width + (size_t)x];
            if (key != EMPTY)
                sum += clamp((depth - depth_of(key)) / way, 0.0f, STEEPEST);
        }
    return exp(-DARKENING * 0.125f * sum);
}

/* Parameters  keys, numbers  in  (height, width) of all points
 *             normals     in   (count, 3) unit vectors, LPS; nothing of it is read without SHADED_BY_NORMALS
 *             colors      in   (count) rgb, 0 to 255, and 255
 *             highlights  in   (HIGHLIGHTS) see rays/shade.h
 *             view        in   as in splat_depths
 *             image       out  (height, width) rgba
 *             depths      out  (height, width) mm along the ray; NaN where nothing is hit
 *             background       rgb, and 1 where it fills the pixels without a point
 *             shading          UNSHADED_POINTS or how; apart: pixels to the neighbours of SHADED_BY_DEPTHS
 *             first, count     numbers of the points that this launch shades; pixels of other points stay
 * Launch      global = width * height rounded up by the host, any local
 * Guarantees  pixels without a point are written by the launch with `first` 0; each other one by the launch of its point */
__kernel void shade_splats(
    __global const uint *restrict keys, __global const uint *restrict numbers, __global const float *restrict normals,
    __global const uchar4 *restrict colors, __global const float *restrict highlights,
    __global const float4 *restrict view, __global uchar4 *restrict image, __global float *restrict depths,
    const float4 background, const int shading, const int apart, const uint first, const uint count, const int width,
    const int height)
{
    const uint at = get_global_id(0);
    if (at >= (uint)width * (uint)height)
        return;
    const uint number = numbers[at];
    if (number == EMPTY) {
        if (first == 0) {
            image[at] = finish_color((float4)(0.0f), background);
            depths[at] = NAN;
        }
        return;
    }
    if (number < first || number - first >= count)
        return;
    const float4 pixel = view[EYE_PIXEL];
    const int column = (int)(at % (uint)width), row = (int)(at / (uint)width);
    const float3 ray = find_ray(view, column, row);
    const float length_of_ray = sqrt(dot3(ray, ray)), depth = depth_of(keys[at]);
    float3 color = convert_float3(colors[number - first].xyz) / 255.0f;
    if (shading == SHADED_BY_NORMALS)
        color = shade_place(view[EYE_PHONG], view[EYE_LIGHT], highlights, color,
            vload3(number - first, normals), ray / length_of_ray);
    else if (shading == SHADED_BY_DEPTHS)
        color *= find_eye_dome(keys, pixel, depth, column, row, apart, width, height);
    image[at] = finish_color((float4)(color, 1.0f), background);
    depths[at] = pixel.w > 0.0f ? depth * length_of_ray : depth;
}
