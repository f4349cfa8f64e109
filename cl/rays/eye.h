/* The camera of pictures that are drawn object by object, and what is nearest in each pixel.
 *
 * The host gives a table of float4, `view`, with one entry for each name below.  Places are mm to the right and up, and
 * the depth across the view.  A parallel camera's pixels are `EYE_PIXEL` mm apart, those of a perspective one that many
 * mm at a depth of 1 mm. */
#ifndef CLRECON_EYE_H
#define CLRECON_EYE_H

#define EMPTY 0xffffffffu /* key and number of a pixel in which nothing is */
#define NEAREST_MM 1e-3f /* what is nearer to a perspective camera, or behind it, is not seen */

#define EYE_RIGHT 0 /* xyz: unit vectors of the camera, LPS; w: what makes coordinates count from its position */
#define EYE_UP 1
#define EYE_FORWARD 2
#define EYE_PIXEL 3 /* x: side of a pixel, mm or tangent; y, z: half the width and height in pixels; w: 1 in perspective */
#define EYE_LIGHT 4 /* as VIEW_LIGHT */
#define EYE_PHONG 5 /* as VIEW_PHONG */

/* Bits that are ordered as the numbers are, those below 0 too. */
static inline uint key_of(const float depth)
{
    const uint bits = as_uint(depth);
    return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

static inline float depth_of(const uint key) { return as_float(key & 0x80000000u ? key & 0x7fffffffu : ~key); }

/* Direction of the ray of a pixel, LPS; its length is that of the ray for 1 mm of depth. */
static inline float3 find_ray(__global const float4 *view, const int column, const int row)
{
    const float4 pixel = view[EYE_PIXEL];
    const float aside = (((float)column + 0.5f) - pixel.y) * pixel.x, upwards = (pixel.z - ((float)row + 0.5f)) * pixel.x;
    return view[EYE_FORWARD].xyz
        + (pixel.w > 0.0f ? aside * view[EYE_RIGHT].xyz + upwards * view[EYE_UP].xyz : (float3)(0.0f));
}

#endif
