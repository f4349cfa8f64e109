/* Squares of distances to triangles, of which a corner and two edges are kept.
 *
 * Reference: C. Ericson, "Real-Time Collision Detection", 2005, section 5.1.5 (closest point on a triangle by Voronoi
 * regions).
 *
 *             \ 2 /
 *              \ /            1, 2, 3  a corner is nearest
 *              / \            12, 23, 31  an edge
 *       12    /   \    23     0  the face
 *            /  0  \
 *       ____/_______\____     p runs from corner 1 to corner 2, q from corner 1 to corner 3
 *        1 /   31    \ 3
 */
#ifndef CLRECON_FACE_FRAMES_H
#define CLRECON_FACE_FRAMES_H

#define NO_FACE (-1)

/* Memory that is read soon; nothing where the driver knows no prefetch. */
#ifdef HAS_BUILTIN_PREFETCH
#define PREFETCH(place) __builtin_prefetch((const void *)(size_t)(place))
#else
#define PREFETCH(place)
#endif

static inline float3 place_of(__global const float *places, const uint vertex)
{
    return vload3(vertex, places);
}

/* Square of the distance from a point, (x, y, z) away from the first corner, to a point of the triangle: the nearest one,
 * or one that rounding put near it.  The shares of p and q are never below 0 nor, together, above 1.  NaN, if anything,
 * for a triangle without area: no comparison holds for it.  (No returns from its middle: rusticl of Mesa 22 then takes wrong
 * branches.)  With `real` a vector, of each lane. */
#define SQUARE_IN_FRAME(name, real, truth) \
    static inline real name( \
        const real x, const real y, const real z, const real px, const real py, const real pz, const real qx, \
        const real qy, const real qz) \
    { \
        const real pp = px * px + py * py + pz * pz, pq = px * qx + py * qy + pz * qz, qq = qx * qx + qy * qy + qz * qz; \
        const real along_p = x * px + y * py + z * pz, along_q = x * qx + y * qy + z * qz; \
        const real p2 = along_p - pp, q2 = along_q - pq, p3 = along_p - pq, q3 = along_q - qq; \
        const real first = p2 * q3 - p3 * q2, second = p3 * along_q - along_p * q3; \
        const real third = along_p * q2 - p2 * along_q; \
        const truth at_1 = (along_p <= 0.0f) & (along_q <= 0.0f), at_2 = (p2 >= 0.0f) & (q2 <= p2); \
        const truth at_3 = (q3 >= 0.0f) & (p3 <= q3), at_12 = (third <= 0.0f) & (along_p >= 0.0f) & (p2 <= 0.0f); \
        const truth at_31 = (second <= 0.0f) & (along_q >= 0.0f) & (q3 <= 0.0f); \
        const truth at_23 = (first <= 0.0f) & (q2 >= p2) & (p3 >= q3); \
        real of_p = at_23 ? p3 - q3 : second, of_q = at_23 ? q2 - p2 : third; \
        real all = of_p + of_q + (at_23 ? (real)(0.0f) : first); \
        of_p = (at_31 | at_3) ? (real)(0.0f) : of_p; \
        of_q = at_3 ? (real)(1.0f) : at_31 ? along_q : of_q; \
        all = at_3 ? (real)(1.0f) : at_31 ? qq : all; \
        of_p = at_1 ? (real)(0.0f) : at_2 ? (real)(1.0f) : at_12 ? along_p : of_p; \
        of_q = (at_1 | at_2 | at_12) ? (real)(0.0f) : of_q; \
        all = (at_1 | at_2) ? (real)(1.0f) : at_12 ? pp : all; \
        const real scale = 1.0f / all; \
        const real v = clamp(of_p * scale, (real)(0.0f), (real)(1.0f)), w = clamp(of_q * scale, (real)(0.0f), 1.0f - v); \
        const real ax = x - px * v - qx * w, ay = y - py * v - qy * w, az = z - pz * v - qz * w; \
        return ax * ax + ay * ay + az * az; \
    }
SQUARE_IN_FRAME(square_in_frame, float, int)
#if LANES == 8
SQUARE_IN_FRAME(four_in_frame, float4, int4)
SQUARE_IN_FRAME(squares_in_frames, float8, int8)
#endif

static inline float square_to_frame(__global const float4 *frames, const float3 point, const int row)
{
    const float4 one = frames[3 * row], p = frames[3 * row + 1], q = frames[3 * row + 2];
    return square_in_frame(point.x - one.x, point.y - one.y, point.z - one.z, p.x, p.y, p.z, q.x, q.y, q.z);
}

/* A surface to which distances are measured.  stars: of each vertex the edges of its first eight faces, see `gather_stars`. */
typedef struct {
    __global const float *places;
    __global const uint *faces;
    __global const int *begin, *around;
    __global const float4 *frames;
    __global const float8 *stars;
} target;

static inline float square_to(const target *to, const float3 point, const int row)
{
    return square_to_frame(to->frames, point, row);
}

#if LANES == 8
/* The least of eight squares, and the first of the lanes that have it; NaN is not. */
static inline float least_of(const float8 squares, int *lane)
{
    const float8 known = squares < (float8)(MAXFLOAT) ? squares : (float8)(MAXFLOAT);
    const float4 four = min(known.lo, known.hi);
    const float2 two = min(four.lo, four.hi);
    const float least = min(two.x, two.y);
    const int8 lanes = known == (float8)(least) ? (int8)(0, 1, 2, 3, 4, 5, 6, 7) : (int8)(7);
    const int4 of_four = min(lanes.lo, lanes.hi);
    const int2 of_two = min(of_four.lo, of_four.hi);
    *lane = min(of_two.x, of_two.y);
    return least;
}

/* Look at the first eight faces around a vertex; `away` is the place of the point from it. */
static inline void look_at_star(__global const float8 *star, const float3 away, float *least, int *nearest)
{
    int lane;
    const float square = least_of(
        squares_in_frames(
            (float8)(away.x), (float8)(away.y), (float8)(away.z), star[0], star[1], star[2], star[3], star[4], star[5]),
        &lane);
    if (square < *least) {
        *least = square;
        *nearest = as_int(((__global const float *)(star + 6))[lane]);
    }
}
#else
static inline void look_at_star(__global const float8 *star, const float3 away, float *least, int *nearest)
{
    __global const float *lanes = (__global const float *)star;
    for (int lane = 0; lane < 8; ++lane) {
        const float square = square_in_frame(
            away.x, away.y, away.z, lanes[lane], lanes[8 + lane], lanes[16 + lane], lanes[24 + lane], lanes[32 + lane],
            lanes[40 + lane]);
        if (square < *least) {
            *least = square;
            *nearest = as_int(lanes[48 + lane]);
        }
    }
}
#endif

/* The least of the squares of the distances to the faces around a vertex, if it is less than `least`. */
static inline void look_around(const target *to, const float3 point, const uint vertex, float *least, int *nearest)
{
    const int begin = to->begin[vertex], end = to->begin[vertex + 1u];
    if (begin < end)
        look_at_star(to->stars + 7u * vertex, point - place_of(to->places, vertex), least, nearest);
    for (int entry = begin + 8; entry < end; ++entry) {
        const int row = to->around[entry];
        const float other = square_to(to, point, row);
        if (other < *least) {
            *least = other;
            *nearest = row;
        }
    }
}

/* The corner of a face that is nearest to a point. */
static inline uint nearest_corner(const target *to, const float3 point, const int face)
{
    const uint3 corners = vload3((uint)face, to->faces);
    const float3 a = point - to->frames[3 * face].xyz, b = a - to->frames[3 * face + 1].xyz,
                 c = a - to->frames[3 * face + 2].xyz;
    const float one = dot3(a, a), two = dot3(b, b), three = dot3(c, c);
    return one <= two && one <= three ? corners.x : two <= three ? corners.y : corners.z;
}

#endif
