/* The nearest point of a triangle, and the faces around a vertex.
 *
 * Reference: C. Ericson, "Real-Time Collision Detection", 2005, section 5.1.5 (closest point on a triangle by Voronoi
 * regions).
 *
 *             \ 2 /
 *              \ /            1, 2, 3  a corner is nearest
 *              / \            12, 23, 31  an edge
 *       12    /   \    23     0  the face
 *            /  0  \
 *       ____/_______\____
 *        1 /   31    \ 3
 */
#ifndef CLRECON_NEAR_FACES_H
#define CLRECON_NEAR_FACES_H

#define NO_FACE (-1)

static inline float3 place_of(__global const float *restrict places, const uint vertex)
{
    return vload3(vertex, places);
}

/* Square of the distance from a point to a point of the triangle: the nearest one, or one that rounding put near it.
 * Its shares of the two edges are never below 0 nor, together, above 1, so that it is a point of the triangle.  NaN, if
 * anything, for a triangle without area: no comparison holds for it. */
static inline float square_to_face(const float3 point, const float3 one, const float3 two, const float3 three)
{
    const float3 p = two - one, q = three - one, away = point - one;
    const float d1 = dot3(p, away), d2 = dot3(q, away);
    if (d1 <= 0.0f && d2 <= 0.0f)
        return dot3(away, away);
    const float3 from_two = point - two;
    const float d3 = dot3(p, from_two), d4 = dot3(q, from_two);
    if (d3 >= 0.0f && d4 <= d3)
        return dot3(from_two, from_two);
    float3 left;
    const float vc = d1 * d4 - d3 * d2;
    if (vc <= 0.0f && d1 >= 0.0f && d3 <= 0.0f) {
        left = away - p * (d1 / (d1 - d3));
        return dot3(left, left);
    }
    const float3 from_three = point - three;
    const float d5 = dot3(p, from_three), d6 = dot3(q, from_three);
    if (d6 >= 0.0f && d5 <= d6)
        return dot3(from_three, from_three);
    const float vb = d5 * d2 - d1 * d6;
    if (vb <= 0.0f && d2 >= 0.0f && d6 <= 0.0f) {
        left = away - q * (d2 / (d2 - d6));
        return dot3(left, left);
    }
    const float va = d3 * d6 - d5 * d4;
    if (va <= 0.0f && d4 >= d3 && d5 >= d6) {
        left = from_two - (three - two) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)));
        return dot3(left, left);
    }
    const float v = max(vb / (va + vb + vc), 0.0f), w = max(vc / (va + vb + vc), 0.0f), both = max(v + w, 1.0f);
    left = away - p * (v / both) - q * (w / both);
    return dot3(left, left);
}

static inline float square_to_row(
    __global const float *restrict places, __global const uint *restrict faces, const float3 point, const int row)
{
    const uint3 face = vload3((uint)row, faces);
    return square_to_face(point, place_of(places, face.x), place_of(places, face.y), place_of(places, face.z));
}

/* The least of the squares of the distances to the faces around a vertex, if it is less than `least`.  Once it is below
 * `enough`, the rest of them is left out. */
static inline void look_around(
    __global const float *restrict places, __global const uint *restrict faces, __global const int *restrict begin,
    __global const int *restrict around, const float3 point, const int vertex, const float enough, float *least,
    int *nearest)
{
    const int end = begin[vertex + 1];
    for (int entry = begin[vertex]; entry < end && !(*least < enough); ++entry) {
        const int row = around[entry];
        const float square = square_to_row(places, faces, point, row);
        if (square < *least) {
            *least = square;
            *nearest = row;
        }
    }
}

#endif
