/* Pictures of triangles: in each pixel the nearest one, or the nearest behind what an earlier layer showed.
 *
 * References: Catmull 1974, "A subdivision algorithm for computer display of curved surfaces" (depth buffer); Everitt
 * 2001, "Interactive order-independent transparency" (depth peeling); rays/triangle.h (coverage).
 *
 *      a box of at most SMALL_PIXELS:        a larger box, cut into pieces of PIECE x PIECE pixels:
 *      one work-item draws the triangle      one work-item a piece, found by the sums of pieces
 *            +------+                              +----+----+----+
 *            |  /\  |                              |  0 | /1 |  2 |      sums  ... 17  17  20 ...   piece 18 is number 1
 *            | /__\ |                              +----/----\----+      of triangles 5   6   7     of triangle 6
 *            +------+                              +---/-+----+---\
 *
 * Passes
 *   1. place_vertices   vertices as the camera sees them
 *   2. count_pieces     pieces of the large triangles; the host sums them up
 *   for each layer (cl/rays/layers.cl begins it)
 *   3. draw_triangles, draw_pieces    least key of a depth behind the floor: atomic minimum
 *   4. the same again                 least number of a triangle at that depth
 *   5. shade_triangles  colour and depth of the triangle of each pixel
 *
 * The floor of a pixel is key and number of the layer before: fragments count in the order of depth, and of equal depth
 * in that of their numbers.  Minima do not depend on the order of the work-items, and what decides between triangles is
 * computed in one order without contraction. */
#include "rays/triangle.h"
#include "rays/shade.h"

#define SMALL_PIXELS 128 /* most pixels of a box that a single work-item draws */
#define PIECE 16 /* pixels along each side of a piece of a larger box */
#define MARGIN 0.02f /* pixels around a box, for the rounding of its quotients */

/* Pixels that hold a triangle; the last ones excluded. */
typedef struct {
    int left, right, top, bottom;
} pixel_box;

/* Places of the picture that a box has to hold, in pixels. */
typedef struct {
    float least_x, most_x, least_y, most_y, margin;
} extent;

static inline void widen(extent *e, const float x, const float y, const float side, const float4 pixel)
{
    const float column = x / side + pixel.y, row = pixel.z - y / side;
    e->least_x = min(e->least_x, column);
    e->most_x = max(e->most_x, column);
    e->least_y = min(e->least_y, row);
    e->most_y = max(e->most_y, row);
}

static inline pixel_box find_box(const corners *c, const float4 pixel, const int width, const int height)
{
    extent e = { MAXFLOAT, -MAXFLOAT, MAXFLOAT, -MAXFLOAT, MARGIN };
    pixel_box box = { 0, 0, 0, 0 };
    for (int corner = 0; corner < 3; ++corner) {
        const int next = corner < 2 ? corner + 1 : 0;
        const float depth = c->depth[corner], ahead = c->depth[next];
        const int in_front = pixel.w <= 0.0f || depth >= NEAREST_MM;
        if (in_front)
            widen(&e, c->x[corner], c->y[corner], pixel.w > 0.0f ? pixel.x * depth : pixel.x, pixel);
        if (pixel.w > 0.0f && in_front != (ahead >= NEAREST_MM)) {
            /* The edge leaves what is seen: its place there, with the rounding of the way to it. */
            const float part = clamp((NEAREST_MM - depth) / (ahead - depth), 0.0f, 1.0f);
            const float x = c->x[corner] + part * (c->x[next] - c->x[corner]);
            const float y = c->y[corner] + part * (c->y[next] - c->y[corner]);
            const float longest = max(max(fabs(c->x[corner]), fabs(c->x[next])), max(fabs(c->y[corner]), fabs(c->y[next])));
            const float deepest = max(fabs(depth), fabs(ahead));
            widen(&e, x, y, pixel.x * NEAREST_MM, pixel);
            e.margin = max(e.margin, 1e-6f * (longest + deepest) / (pixel.x * NEAREST_MM));
        }
    }
    if (e.most_x < e.least_x)
        return box;
    const float w = (float)width, h = (float)height;
    box.left = (int)clamp(ceil(e.least_x - e.margin - 0.5f), 0.0f, w);
    box.right = (int)clamp(floor(e.most_x + e.margin - 0.5f) + 1.0f, 0.0f, w);
    box.top = (int)clamp(ceil(e.least_y - e.margin - 0.5f), 0.0f, h);
    box.bottom = (int)clamp(floor(e.most_y + e.margin - 0.5f) + 1.0f, 0.0f, h);
    return box;
}

static inline int is_empty(const pixel_box *b) { return b->right <= b->left || b->bottom <= b->top; }

static inline int is_small(const pixel_box *b)
{
    return (b->right - b->left) <= SMALL_PIXELS && (b->bottom - b->top) <= SMALL_PIXELS
        && (b->right - b->left) * (b->bottom - b->top) <= SMALL_PIXELS;
}

static inline uint count_across(const int first, const int end) { return (uint)((end - first + PIECE - 1) / PIECE); }

/* Bring a triangle's depths, or with `finds_numbers` its number, to the pixels of a box. */
static inline void draw_box(const corners *c, const pixel_box *b, const float4 pixel, const uint number,
    __global const float4 *planes, const uint plane_count, __global uint *keys, __global uint *numbers,
    __global const uint *floor_keys, __global const uint *floor_numbers, const int finds_numbers, const int width)
{
    const uint nearest = key_of(min(min(c->depth[0], c->depth[1]), c->depth[2]));
    const uint farthest = key_of(max(max(c->depth[0], c->depth[1]), c->depth[2]));
    for (int row = b->top; row < b->bottom; ++row)
        for (int column = b->left; column < b->right; ++column) {
            /* Keys are known where numbers are found: most of what is hidden needs no further look. */
            const size_t at = (size_t)row * (size_t)width + (size_t)column;
            const uint below = floor_keys[at];
            if (farthest < below || (finds_numbers && (keys[at] < nearest || keys[at] > farthest)))
                continue;
            meeting m;
            if (!meet_triangle(c, pixel, column, row, &m))
                continue;
            const uint key = key_of(m.depth);
            if (key < below || (key == below && number <= floor_numbers[at]))
                continue;
            if (plane_count > 0 && !is_kept(planes, plane_count, pixel, column, row, m.depth))
                continue;
            if (!finds_numbers)
                atomic_min(keys + at, key);
            else if (keys[at] == key)
                atomic_min(numbers + at, number);
        }
}

/* Parameters  vertices  in   (count, 3) mm, LPS from the base of the view's table
 *             view      in   (6) float4, see rays/eye.h
 *             placed    out  (count, 3) mm to the right and up, and the depth
 * Launch      global = count rounded up by the host, any local
 * Assumes     vertices are finite */
__kernel void place_vertices(__global const float *restrict vertices, __global const float4 *restrict view,
    __global float *restrict placed, const uint count)
{
    const size_t vertex = get_global_id(0);
    if (vertex >= count)
        return;
    const float x = vertices[3 * vertex], y = vertices[3 * vertex + 1], z = vertices[3 * vertex + 2];
    for (int axis = 0; axis < 3; ++axis) {
        const float4 way = view[EYE_RIGHT + axis];
        placed[3 * vertex + axis] = ((way.x * x + way.y * y) + way.z * z) + way.w;
    }
}

/* Parameters  placed     in   see place_vertices
 *             triangles  in   (count, 3) vertices
 *             view       in   see place_vertices
 *             pieces     out  (count) of triangles with more than SMALL_PIXELS; 0 for the others
 * Launch      global = count rounded up by the host, any local
 * Assumes     every triangle has vertices that exist */
__kernel void count_pieces(__global const float *restrict placed, __global const uint *restrict triangles,
    __global const float4 *restrict view, __global uint *restrict pieces, const uint count, const int width,
    const int height)
{
    const size_t triangle = get_global_id(0);
    if (triangle >= count)
        return;
    const corners c = load_corners(placed, triangles, triangle);
    const pixel_box b = find_box(&c, view[EYE_PIXEL], width, height);
    pieces[triangle] = is_empty(&b) || is_small(&b) ? 0 : count_across(b.left, b.right) * count_across(b.top, b.bottom);
}

/* Parameters  placed, triangles, view  in  see count_pieces
 *             planes   in      (plane_count) clip planes, see is_kept()
 *             keys     in/out  (height, width) least key of a depth so far
 *             numbers  in/out  (height, width) least number of a triangle at that depth so far
 *             floor_keys, floor_numbers  in  (height, width) what lies at or before them does not count
 *             first    number of the first of these triangles
 *             finds_numbers  0: keys are written; 1: numbers
 * Launch      global = count rounded up by the host, any local
 * Assumes     numbers of triangles are below EMPTY; keys are those of all triangles where numbers are found
 * Guarantees  keys and numbers do not depend on the order of the triangles' work */
__kernel void draw_triangles(__global const float *restrict placed, __global const uint *restrict triangles,
    __global const float4 *restrict view, __global const float4 *restrict planes, __global uint *keys,
    __global uint *numbers, __global const uint *restrict floor_keys, __global const uint *restrict floor_numbers,
    const uint plane_count, const uint first, const uint count, const int finds_numbers, const int width,
    const int height)
{
    const size_t triangle = get_global_id(0);
    if (triangle >= count)
        return;
    const corners c = load_corners(placed, triangles, triangle);
    const pixel_box b = find_box(&c, view[EYE_PIXEL], width, height);
    if (!is_empty(&b) && is_small(&b))
        draw_box(&c, &b, view[EYE_PIXEL], first + (uint)triangle, planes, plane_count, keys, numbers, floor_keys,
            floor_numbers, finds_numbers, width);
}

/* Parameters  sums         in  (count) pieces of all triangles before each
 *             first_piece  that this launch draws;  end_piece: the first that it does not
 *             others       as draw_triangles
 * Launch      global = end_piece - first_piece rounded up by the host, any local
 * Assumes     end_piece is at most the number of all pieces
 * Guarantees  as draw_triangles */
__kernel void draw_pieces(__global const float *restrict placed, __global const uint *restrict triangles,
    __global const uint *restrict sums, __global const float4 *restrict view, __global const float4 *restrict planes,
    __global uint *keys, __global uint *numbers, __global const uint *restrict floor_keys,
    __global const uint *restrict floor_numbers, const uint plane_count, const uint first, const uint count,
    const uint first_piece, const uint end_piece, const int finds_numbers, const int width, const int height)
{
    const uint item = get_global_id(0);
    if (item >= end_piece - first_piece)
        return;
    const uint piece = first_piece + item;
    uint triangle = 0, beyond = count; /* sums[triangle] <= piece < sums[beyond] */
    while (beyond - triangle > 1) {
        const uint middle = triangle + (beyond - triangle) / 2;
        if (sums[middle] <= piece)
            triangle = middle;
        else
            beyond = middle;
    }
    const corners c = load_corners(placed, triangles, triangle);
    pixel_box b = find_box(&c, view[EYE_PIXEL], width, height);
    const uint own = piece - sums[triangle], across = count_across(b.left, b.right);
    b.left += (int)(own % across) * PIECE;
    b.top += (int)(own / across) * PIECE;
    b.right = min(b.left + PIECE, b.right);
    b.bottom = min(b.top + PIECE, b.bottom);
    draw_box(&c, &b, view[EYE_PIXEL], first + triangle, planes, plane_count, keys, numbers, floor_keys, floor_numbers,
        finds_numbers, width);
}

/* Parameters  placed, triangles, view  in  see count_pieces
 *             normals     in   (vertices, 3) of any length, LPS; nothing of it is read without has_normals
 *             colors      in   (vertices) rgb, 0 to 255, and 255; nothing of it is read without has_colors
 *             highlights  in   (HIGHLIGHTS) see rays/shade.h
 *             numbers     in   (height, width) of all triangles
 *             keys        in/out  (height, width) of all triangles; EMPTY where an opaque one is seen: nothing is behind
 *             layer       out  (height, width) rgb with light, and opacity
 *             layer_depths  out  (height, width) mm along the ray
 *             color       rgb and opacity of the triangles
 *             shaded      0: colours as they are
 *             first, count  numbers of the triangles that this launch shades; pixels of others stay
 * Launch      global = width * height rounded up by the host, any local
 * Guarantees  a normal is that of the side that is seen: both sides of a surface are lit */
__kernel void shade_triangles(__global const float *restrict placed, __global const uint *restrict triangles,
    __global const float4 *restrict view, __global const float *restrict normals,
    __global const uchar4 *restrict colors, __global const float *restrict highlights,
    __global const uint *restrict numbers, __global uint *restrict keys, __global float4 *restrict layer,
    __global float *restrict layer_depths, const float4 color, const int has_normals, const int has_colors,
    const int shaded, const uint first, const uint count, const int width, const int height)
{
    const uint at = get_global_id(0);
    if (at >= (uint)width * (uint)height)
        return;
    const uint number = numbers[at];
    if (number == EMPTY || number < first || number - first >= count)
        return;
    const int column = (int)(at % (uint)width), row = (int)(at / (uint)width);
    const float4 pixel = view[EYE_PIXEL];
    const size_t triangle = number - first;
    const corners c = load_corners(placed, triangles, triangle);
    meeting m;
    meet_triangle(&c, pixel, column, row, &m);
    const float3 share = (float3)(m.share[0], m.share[1], m.share[2]) / m.total;
    const size_t a = triangles[3 * triangle], b = triangles[3 * triangle + 1], last = triangles[3 * triangle + 2];
    float3 rgb = color.xyz;
    if (has_colors)
        rgb = (share.x * convert_float3(colors[a].xyz) + share.y * convert_float3(colors[b].xyz)
                  + share.z * convert_float3(colors[last].xyz)) / 255.0f;
    const float3 ray = find_ray(view, column, row);
    const float length_of_ray = sqrt(dot3(ray, ray));
    if (shaded) {
        const float3 direction = ray / length_of_ray;
        /* The face's normal, by its corners as the camera sees them, then in LPS. */
        const float3 p = (float3)(c.x[1] - c.x[0], c.y[1] - c.y[0], c.depth[1] - c.depth[0]);
        const float3 q = (float3)(c.x[2] - c.x[0], c.y[2] - c.y[0], c.depth[2] - c.depth[0]);
        /* Right, up and into the picture are a left-handed triple. */
        const float3 own = cross3(q, p);
        float3 face = own.x * view[EYE_RIGHT].xyz + own.y * view[EYE_UP].xyz + own.z * view[EYE_FORWARD].xyz;
        const float size = dot3(face, face);
        face = size > 0.0f ? face / sqrt(size) : -direction;
        float3 normal = face;
        if (has_normals) {
            normal = share.x * vload3(a, normals) + share.y * vload3(b, normals) + share.z * vload3(last, normals);
            normal = dot3(normal, face) < 0.0f ? -normal : normal;
        }
        /* Normals between corners may look away from the camera where the face does not: they end at its rim. */
        const float away = dot3(normal, direction);
        if (away * dot3(face, direction) < 0.0f)
            normal -= 1.001f * away * direction;
        rgb = shade_place(view[EYE_PHONG], view[EYE_LIGHT], highlights, rgb, normal, direction);
    }
    layer[at] = (float4)(rgb, color.w);
    layer_depths[at] = m.depth * length_of_ray;
    if (color.w >= 1.0f)
        keys[at] = EMPTY;
}
