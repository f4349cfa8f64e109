/* Light at a single place (Phong 1975, with Blinn's halfway vector); reads no volume.  Normals are turned towards
 * the viewer, as in rays/phong.h. */
#ifndef CLRECON_SHADE_H
#define CLRECON_SHADE_H

#define HIGHLIGHTS 1024 /* entries of a table of specular * cosine ^ power: library powers take 0.2 us on CPU drivers */

/* `color` of a surface with LPS gradient `gradient`, seen along unit vector `direction`; places without a gradient
 * keep ambient and diffuse light.  `phong`: ambient, diffuse, specular, power; `fixed_light`: LPS direction to a light
 * that stands still and 1, or 0 for a light at the camera. */
static inline float3 shade_place(const float4 phong, const float4 fixed_light, __global const float *highlights,
    const float3 color, const float3 gradient, const float3 direction)
{
    const float size = dot3(gradient, gradient);
    if (size < 1e-12f)
        return min(color * (phong.x + phong.y), 1.0f);
    const float3 normal = gradient * (1.0f / sqrt(size));
    const float3 light = fixed_light.w > 0.0f ? fixed_light.xyz : -direction;
    const float along = dot3(normal, light);
    if (along * dot3(normal, direction) >= 0.0f)
        return min(color * phong.x, 1.0f); /* light and viewer on different sides */
    float highlight_angle = fabs(along);
    const float diffuse = phong.y * highlight_angle;
    if (fixed_light.w > 0.0f) {
        const float3 middle = light - direction;
        highlight_angle = fabs(dot3(normal, middle)) / sqrt(max(dot3(middle, middle), 1e-12f));
    }
    const float entry = min(highlight_angle, 1.0f) * (HIGHLIGHTS - 1);
    const int at = min((int)entry, HIGHLIGHTS - 2);
    const float highlight = highlights[at] + (entry - (float)at) * (highlights[at + 1] - highlights[at]);
    return min(color * (phong.x + diffuse) + highlight, 1.0f);
}

#endif
