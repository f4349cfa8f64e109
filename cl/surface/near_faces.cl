/* Upper bounds of the distances from points to a surface, where vertices of the surface near each point are known.
 *
 *      point .                     hint: a vertex near the point.  The faces around it are measured, then those around
 *             \                    the next hint; then, from the nearest face so far, its corner that is nearest to
 *        ______\______             the point is the next vertex (a walk).  As soon as a face is near enough, it ends.
 *       /\    / \    /\
 *      /  \  /   \  /  \           A distance to one face is never less than that to the surface.
 *     /____\/_____\/____\
 *         hint   nearest corner
 *
 * Reference: near_faces.h.
 *
 * Passes
 *   1. find_near_faces   points to a surface
 *   2. find_witnesses    triangles of another surface: faces that show that all of a triangle is near enough */

#include "surface/near_faces.h"
#include "surface/picks.h"

#define WITNESSES 7 /* of a triangle: for its corners, its middle and the middles of its edges */
#define MIDDLES 4

/* Parameters  points     in   (count, 3) mm
 *             near       in   (count, hints) vertices near each point
 *             places     in   (n, 3) mm, vertices of the surface
 *             faces      in   (m, 3) vertices of each face
 *             begin      in   (n + 1) where the faces around each vertex begin in `around`
 *             around     in   (3 m) rows of faces
 *             squares    out  (count) mm2: square of the distance to the nearest of the faces that were measured
 *             rows       out  (count) that face
 *             hints      vertices for each point, at least 1
 *             walks      most steps from face to face after the hints
 *             enough     mm2: below it nothing nearer is looked for
 *             count
 * Launch      global = count, rounded up by the host, any local
 * Assumes     all vertices are below n and all rows below m
 * Guarantees  both are written for every point: MAXFLOAT and NO_FACE where no hint has faces */
__kernel void find_near_faces(
    __global const float *restrict points, __global const int *restrict near, __global const float *restrict places,
    __global const uint *restrict faces, __global const int *restrict begin, __global const int *restrict around,
    __global float *restrict squares, __global int *restrict rows, const int hints, const int walks, const float enough,
    const uint count)
{
    const uint number = get_global_id(0);
    if (number >= count)
        return;
    const float3 point = vload3(number, points);
    float least = MAXFLOAT;
    int nearest = NO_FACE, vertex = -1;
    for (int hint = 0; hint < hints && !(least < enough); ++hint) {
        vertex = near[number * (uint)hints + (uint)hint];
        look_around(places, faces, begin, around, point, vertex, enough, &least, &nearest);
    }
    for (int walk = 0; walk < walks && nearest != NO_FACE && !(least < enough); ++walk) {
        const uint3 face = vload3((uint)nearest, faces);
        const float3 a = place_of(places, face.x) - point, b = place_of(places, face.y) - point,
                     c = place_of(places, face.z) - point;
        const float one = dot3(a, a), two = dot3(b, b), three = dot3(c, c);
        const int next = (int)(one <= two && one <= three ? face.x : two <= three ? face.y : face.z);
        if (next == vertex)
            break;
        vertex = next;
        look_around(places, faces, begin, around, point, vertex, enough, &least, &nearest);
    }
    squares[number] = least;
    rows[number] = nearest;
}

/* True where one face is nearer than `enough` to all corners a, b, c of a triangle: that of one of them, in `row`. */
static inline int has_common_face(
    __global const float *restrict places, __global const uint *restrict faces, const float3 a, const float3 b,
    const float3 c, const int3 row, const float enough)
{
    for (int one = 0; one < 3; ++one) {
        const int face = PICK_3(row.x, row.y, row.z, one);
        int all = 1;
        for (int other = 0; other < 3 && all; ++other)
            all = PICK_3(row.x, row.y, row.z, other) == face
                || square_to_row(places, faces, PICK_3(a, b, c, other), face) < enough;
        if (all)
            return 1;
    }
    return 0;
}

/* Parameters  vertices   in   (v, 3) mm, of the triangles that are examined
 *             triangles  in   (count, 3) vertices of each
 *             names      in   (v) for each vertex one of the surface near it
 *             beside     in   (v) for each vertex the row of a face that is nearer than `enough`; NO_FACE: none is
 *             places, faces, begin, around   in   the surface, as above
 *             witnesses  out  (WITNESSES, count) rows of faces: of the corners, of the middle, of the middles of edges
 *             left       out  (count) bit b: middle b is not known to be near enough; 0 where a corner has no face
 *             enough     mm2
 *             count
 * Launch      global = count, rounded up by the host, any local
 * Assumes     as above
 * Guarantees  all is written for every triangle; a middle that one of the faces of the corners shows to be near enough,
 *             and each where one of them does so for all corners, has the face of the first corner */
__kernel void find_witnesses(
    __global const float *restrict vertices, __global const uint *restrict triangles, __global const int *restrict names,
    __global const int *restrict beside, __global const float *restrict places, __global const uint *restrict faces,
    __global const int *restrict begin, __global const int *restrict around, __global int *restrict witnesses,
    __global uchar *restrict left, const float enough, const uint count)
{
    const uint number = get_global_id(0);
    if (number >= count)
        return;
    const uint3 vertex = vload3(number, triangles);
    const int3 row = (int3)(beside[vertex.x], beside[vertex.y], beside[vertex.z]);
    const float3 a = place_of(vertices, vertex.x), b = place_of(vertices, vertex.y), c = place_of(vertices, vertex.z);
    witnesses[number] = row.x;
    witnesses[count + number] = row.y;
    witnesses[2u * count + number] = row.z;
    for (uint middle = 0; middle < MIDDLES; ++middle)
        witnesses[(3u + middle) * count + number] = row.x;
    const int known = row.x != NO_FACE && row.y != NO_FACE && row.z != NO_FACE;
    uint undecided = 0;
    if (known && !has_common_face(places, faces, a, b, c, row, enough)) {
        for (int middle = 0; middle < MIDDLES; ++middle) {
            const float3 point
                = middle == 0 ? (a + b + c) * (1.0f / 3.0f) : PICK_3(a + b, b + c, c + a, middle - 1) * 0.5f;
            float least = MAXFLOAT;
            int nearest = NO_FACE;
            for (int i = 0; i < 3 && !(least < enough); ++i)
                least = min(least, square_to_row(places, faces, point, PICK_3(row.x, row.y, row.z, i)));
            if (least < enough)
                continue;
            least = MAXFLOAT;
            for (int i = 0; i < 3 && !(least < enough); ++i)
                look_around(places, faces, begin, around, point, names[PICK_3(vertex.x, vertex.y, vertex.z, i)], 0.0f,
                    &least, &nearest);
            if (least < enough)
                witnesses[(3u + (uint)middle) * count + number] = nearest;
            else
                undecided |= 1u << middle;
        }
    }
    left[number] = (uchar)undecided;
}
