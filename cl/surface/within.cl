/* Triangles of one surface that are not seen to lie within a limit of another one, at each of their points.
 *
 *          /\            The distance to one face is a convex function: where all corners of a piece lie within the
 *         /| \           limit of one face, so does every point of the piece.  If no face is found that is near enough
 *        / |  \          to all corners, the piece is cut at the middle of its longest edge.
 *       /__|___\
 *       one  two         Pieces are looked at in depth-first order; a path has one bit for each cut.
 *
 * Reference: face_frames.h.
 *
 * Passes
 *   1. frame_faces       corner and edges of each face of a surface
 *   2. gather_stars      edges of the faces around each vertex
 *   3. find_near_faces   triangles of another surface */

#include "surface/face_frames.h"
#include "surface/picks.h"

#define SEVERAL (-2)
#define FAR (-3)
#define EASY 0.1f      /* share of the limit below which no face nearer to the middle of a piece is looked for */
#define QUICK_CUTS 12  /* after so many cuts the nearest one is looked for */
#define MOST_CUTS 20   /* a piece that is smaller counts as far */
#define MOST_PIECES 4096
#define MOST_WALKS 32

/* Parameters  places   in   (n, 3) mm
 *             faces    in   (faces, 3)
 *             frames   out  (3 faces,) of each face the first corner, with the square of its longest edge, and the edges
 *                      from it
 *             rows     in   (count,) the faces that are looked at
 *             count
 * Launch      global = count, rounded up by the host, any local
 * Assumes     all vertices are below n
 * Guarantees  written for each of the rows */
__kernel void frame_faces(
    __global const float *restrict places, __global const uint *restrict faces, __global float4 *restrict frames,
    __global const uint *restrict rows, const uint count)
{
    if (get_global_id(0) >= count)
        return;
    const uint face = rows[get_global_id(0)];
    const uint3 corners = vload3(face, faces);
    const float3 one = place_of(places, corners.x);
    const float3 p = place_of(places, corners.y) - one, q = place_of(places, corners.z) - one;
    const float3 r = q - p;
    frames[3u * face] = (float4)(one, max(max(dot3(p, p), dot3(q, q)), dot3(r, r)));
    frames[3u * face + 1u] = (float4)(p, 0.0f);
    frames[3u * face + 2u] = (float4)(q, 0.0f);
}

/* Parameters  places, faces   in   as above
 *             begin   in   (n + 1,) where the faces around each vertex begin in `around`
 *             around  in   rows of faces
 *             stars   out  (7 n,) of each vertex the edges from it in its first eight faces, a lane for each: x, y and z of
 *                     the one to the next corner, and of the one to the corner after that, and the row of the face; the
 *                     last face fills the rest
 *             vertices   in   (count,) the vertices that are looked at
 *             count
 * Launch      global = count, rounded up by the host, any local
 * Assumes     all rows are below the number of faces
 * Guarantees  written for each of the vertices that has a face */
__kernel void gather_stars(
    __global const float *restrict places, __global const uint *restrict faces, __global const int *restrict begin,
    __global const int *restrict around, __global float *restrict stars, __global const uint *restrict vertices,
    const uint count)
{
    if (get_global_id(0) >= count)
        return;
    const uint vertex = vertices[get_global_id(0)];
    if (begin[vertex] == begin[vertex + 1u])
        return;
    const float3 own = place_of(places, vertex);
    for (int lane = 0; lane < 8; ++lane) {
        const uint row = (uint)around[min(begin[vertex] + lane, begin[vertex + 1u] - 1)];
        const uint3 corners = vload3(row, faces);
        const uint next = corners.x == vertex ? corners.y : corners.y == vertex ? corners.z : corners.x;
        const uint last = corners.x == vertex ? corners.z : corners.y == vertex ? corners.x : corners.y;
        const float3 p = place_of(places, next) - own, q = place_of(places, last) - own;
        __global float *star = stars + 56u * vertex + lane;
        star[0] = p.x;
        star[8] = p.y;
        star[16] = p.z;
        star[24] = q.x;
        star[32] = q.y;
        star[40] = q.z;
        star[48] = as_float(row);
    }
}

typedef struct { float3 a, b, c; } triangle;

/* Cut a piece at the middle of its longest edge, and keep its first or its second half. */
static inline void halve_piece(triangle *piece, const int second)
{
    const float3 a = piece->a, b = piece->b, c = piece->c, p = b - a, q = c - b, r = a - c;
    const float one = dot3(p, p), two = dot3(q, q), three = dot3(r, r);
    const int at_p = one >= two && one >= three, at_q = !at_p && two >= three;
    const float3 middle = 0.5f * (at_p ? a + b : at_q ? b + c : c + a);
    /* the corner that the half does not keep: the first end of the edge in the second half, else the other end */
    const int gone = at_p ? (second ? 0 : 1) : at_q ? (second ? 1 : 2) : (second ? 0 : 2);
    piece->a = gone == 0 ? middle : a;
    piece->b = gone == 1 ? middle : b;
    piece->c = gone == 2 ? middle : c;
}

/* The piece of a triangle at the end of a path.  (It is no result: that of three vectors is `noalias`, which Oclgrind 21.10
 * does not know.) */
static inline void find_piece(
    __global const float *triangles, const uint number, const uint path, const uint cuts, triangle *piece)
{
    piece->a = vload3(3u * number, triangles);
    piece->b = vload3(3u * number + 1u, triangles);
    piece->c = vload3(3u * number + 2u, triangles);
    for (uint cut = 0; cut < cuts; ++cut)
        halve_piece(piece, (int)(path >> (cuts - 1u - cut) & 1u));
}

/* Which of two faces has all corners of a piece within the limit: bits 1 and 2. */
#if LANES == 8
static inline int is_near_all(const target *to, const triangle *piece, const int face, const int other, const float limit)
{
    const float4 one = to->frames[3 * face], p = to->frames[3 * face + 1], q = to->frames[3 * face + 2];
    const float4 two = to->frames[3 * other], r = to->frames[3 * other + 1], s = to->frames[3 * other + 2];
    const float4 x = {piece->a.x, piece->b.x, piece->c.x, piece->c.x}, y = {piece->a.y, piece->b.y, piece->c.y, piece->c.y},
                 z = {piece->a.z, piece->b.z, piece->c.z, piece->c.z};
    const int8 is_near = squares_in_frames(
                             (float8)(x - one.x, x - two.x), (float8)(y - one.y, y - two.y),
                             (float8)(z - one.z, z - two.z), (float8)((float4)(p.x), (float4)(r.x)),
                             (float8)((float4)(p.y), (float4)(r.y)), (float8)((float4)(p.z), (float4)(r.z)),
                             (float8)((float4)(q.x), (float4)(s.x)), (float8)((float4)(q.y), (float4)(s.y)),
                             (float8)((float4)(q.z), (float4)(s.z)))
        < (float8)(limit);
    return all(is_near.lo) | all(is_near.hi) << 1;
}
#else
/* Inlined: a piece that is handed to a function lies in memory. */
static inline __attribute__((always_inline)) int is_near_one(
    const target *to, const triangle *piece, const int face, const float limit)
{
    return square_to(to, piece->a, face) < limit && square_to(to, piece->b, face) < limit
        && square_to(to, piece->c, face) < limit;
}

static inline __attribute__((always_inline)) int is_near_all(
    const target *to, const triangle *piece, const int face, const int other, const float limit)
{
    const int first = is_near_one(to, piece, face, limit);
    return first | (int)(!first && other != face && is_near_one(to, piece, other, limit)) << 1;
}
#endif

/* True where an edge of a piece is longer than each of a face: then hardly any face there is near to all of it. */
static inline int exceeds_face(const target *to, const triangle *piece, const int face)
{
    const float3 a = piece->b - piece->a, b = piece->c - piece->b, c = piece->a - piece->c;
    return max(max(dot3(a, a), dot3(b, b)), dot3(c, c)) > to->frames[3 * face].w;
}

/* Walk from a vertex to a face that is nearest among all that touch it, or nearer than `enough`; the square of its
 * distance.  Within the limit only those around one corner are looked at, unless `enough` is 0.  (rusticl of Mesa 22 goes
 * wrong where such a loop ends in its middle.) */
static inline __attribute__((always_inline)) float walk_to(
    const target *to, const float3 point, const int from, const float limit, const float enough, int *nearest)
{
    float least = MAXFLOAT;
    uint vertex = (uint)from;
    int is_going = 1;
    *nearest = NO_FACE;
    for (uint walk = 0; is_going; ++walk) {
        const float before = least;
        look_around(to, point, vertex, &least, nearest);
        const uint here = vertex;
        is_going = *nearest != NO_FACE && !(least < enough) && walk < MOST_WALKS;
        if (is_going) {
            vertex = nearest_corner(to, point, *nearest);
            if (vertex == here || !(least < before)) {
                is_going = !(least < limit && enough > 0.0f);
                if (is_going) { /* all around it */
                    const uint3 face = vload3((uint)*nearest, to->faces);
                    const float of_one = least;
                    for (uint corner = 0; corner < 3; ++corner)
                        look_around(to, point, PICK_3(face.x, face.y, face.z, corner), &least, nearest);
                    vertex = nearest_corner(to, point, *nearest);
                    is_going = least < of_one;
                }
            }
        }
    }
    return least;
}

/* Parameters  triangles  in   (count, 3, 3) mm, corners of the triangles that are looked at
 *             hints      in   (count, 4) a face near each, NO_FACE: none is known; vertices near its corners
 *             places, faces, begin, around   in   the other surface, and the faces around its vertices
 *             frames, stars   in   of the passes before
 *             witnesses  out  (count, 4) faces that are near to its pieces, and NO_FACE; all SEVERAL: there are more; all
 *                        FAR: a piece without one was found
 *             limit      mm2
 *             count
 * Launch      global = count, rounded up by the host, any local
 * Assumes     all vertices are below n and all rows below m
 * Guarantees  written for every triangle; every point of one that is not FAR is nearer than the limit */
__kernel void find_near_faces(
    __global const float *restrict triangles, __global const int *restrict hints, __global const float *restrict places,
    __global const uint *restrict faces, __global const int *restrict begin, __global const int *restrict around,
    __global const float4 *restrict frames, __global const float8 *restrict stars, __global int *restrict witnesses,
    const float limit, const uint count)
{
    const uint number = get_global_id(0);
    if (number >= count)
        return;
    const target to = {places, faces, begin, around, frames, stars};
    const int4 hint = vload4(number, hints);
    int4 used = {NO_FACE, NO_FACE, NO_FACE, NO_FACE};
    int face = hint.x, from = hint.y, uses = 0;
    uint path = 0, cuts = 0;
    int is_going = 1, is_far = 0;
    triangle now, whole; /* the piece that is looked at, and that of which it is the first half */
    find_piece(triangles, number, path, cuts, &now);
    for (uint piece = 0; is_going; ++piece) {
        /* the last face, and those of pieces before */
        const int is_last = used.x == face, before = is_last ? used.y : used.x;
        const int third = is_last ? used.z : used.y, fourth = is_last ? used.w : used.z;
        const int is_wide = face != NO_FACE && exceeds_face(&to, &now, face);
        int is_near = 0;
        if (face != NO_FACE && !is_wide) {
            is_near = is_near_all(&to, &now, face, before == NO_FACE ? face : before, limit);
            if (is_near == 0 && third != NO_FACE)
                is_near = is_near_all(&to, &now, third, fourth == NO_FACE ? third : fourth, limit) << 2;
            face = (is_near & 1) ? face : (is_near & 2) ? before : (is_near & 4) ? third : is_near ? fourth : face;
        }
        if (!is_near && !is_wide) {
            const float3 middle = (now.a + now.b + now.c) * (1.0f / 3.0f);
            const float enough = cuts < QUICK_CUTS ? EASY * limit : 0.0f;
            int nearest = NO_FACE;
            if (face != NO_FACE)
                from = (int)nearest_corner(&to, middle, face);
            float least = walk_to(&to, middle, from, limit, enough, &nearest);
            for (int corner = 0; corner < 3 && !(least < limit); ++corner)
                least = walk_to(&to, middle, PICK_3(hint.y, hint.z, hint.w, corner), limit, 0.0f, &nearest);
            is_far = !(least < limit);
            if (!is_far) {
                face = nearest;
                is_near = is_near_all(&to, &now, face, face, limit);
            }
        }
        if (is_near) {
            if (face != used.x && face != used.y && face != used.z && face != used.w) {
                used = (int4)(face, used.x, used.y, used.z);
                ++uses;
            }
            const int is_first = !(path & 1u);
            while (cuts > 0 && (path & 1u)) {
                path >>= 1;
                --cuts;
            }
            path |= 1u;
            is_going = cuts > 0;
            if (LANES == 8 && is_going && is_first) { /* GPUs have no registers left for it */
                now = whole;
                halve_piece(&now, 1);
            } else if (is_going)
                find_piece(triangles, number, path, cuts, &now);
        } else {
            is_far |= cuts == MOST_CUTS;
            path <<= 1;
            ++cuts;
            whole = now;
            halve_piece(&now, 0);
        }
        is_far |= piece == MOST_PIECES;
        is_going &= !is_far;
    }
    vstore4(is_far ? (int4)(FAR) : uses > 4 ? (int4)(SEVERAL) : used, number, witnesses);
}
