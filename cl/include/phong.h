/* Light on a surface (Phong 1975, with Blinn's halfway vector); both sides of it are lit. */
#ifndef CLRECON_PHONG_H
#define CLRECON_PHONG_H

#include "include/view.h"

#define HIGHLIGHTS 1024 /* entries of a table of specular * cosine ^ power: library powers take 0.2 us on CPU drivers */

/* `color` of a surface with LPS gradient `gradient`, seen along unit vector `direction`; places without a gradient
 * keep ambient and diffuse light. */
static inline float3 shade(__global const float4 *restrict view, __global const float *restrict highlights,
    const float3 color, const float3 gradient, const float3 direction)
{
    const float4 phong = view[VIEW_PHONG];
    const float size = dot(gradient, gradient);
    if (size < 1e-12f)
        return min(color * (phong.x + phong.y), 1.0f);
    const float4 fixed_light = view[VIEW_LIGHT];
    const float3 normal = gradient * (1.0f / sqrt(size));
    const float3 light = fixed_light.w > 0.0f ? fixed_light.xyz : -direction;
    float highlight_angle = fabs(dot(normal, light));
    const float diffuse = phong.y * highlight_angle;
    if (fixed_light.w > 0.0f) {
        const float3 middle = light - direction;
        highlight_angle = fabs(dot(normal, middle)) / sqrt(max(dot(middle, middle), 1e-12f));
    }
    const float entry = min(highlight_angle, 1.0f) * (HIGHLIGHTS - 1);
    const int at = min((int)entry, HIGHLIGHTS - 2);
    const float highlight = highlights[at] + (entry - (float)at) * (highlights[at + 1] - highlights[at]);
    return min(color * (phong.x + diffuse) + highlight, 1.0f);
}

#endif
