"""GLSL of the OpenGL peer: G-buffer, depth alone, and forward shading over all lights.

Formulas are those of docs/conventions.md: Lambert radiance albedo E / π, the window clamp(1 - (d / range)⁴, 0, 1) over
the squared distance, the squared ramp between the cosines of a spot.
"""

from __future__ import annotations

__all__ = ["DEPTH_FRAGMENT", "FORWARD_FRAGMENT", "GBUFFER_FRAGMENT", "VERTEX"]

#: `invariant`: the depth pre-pass and shading must come to the same depth, bit for bit.
VERTEX = """#version 430
uniform mat4 view;
uniform mat4 projection;
in vec3 position;
in vec3 normal;
out vec3 at;
out vec3 upright;
invariant gl_Position;
void main() {
    vec4 seen = view * vec4(position, 1.0);
    at = position;
    upright = normal;
    gl_Position = projection * seen;
}
"""

#: Normal and model, albedo and roughness, four more bytes; with the depth buffer 16 bytes a pixel. No packing that
#: takes arithmetic: data-centre cards have few units for it.
GBUFFER_FRAGMENT = """#version 430
uniform vec3 albedo;
in vec3 upright;
layout(location = 0) out vec4 out_normal;
layout(location = 1) out vec4 out_albedo;
layout(location = 2) out vec4 out_rest;
void main() {
    out_normal = vec4(normalize(upright) * 0.5 + 0.5, 2.0 / 255.0);
    out_albedo = vec4(albedo, 1.0);
    out_rest = vec4(0.0, 1.0, 0.0, 0.0);
}
"""

DEPTH_FRAGMENT = """#version 430
void main() {}
"""

#: A light is five vectors: (position, range), (colour, casts), (axis, scale), (offset, map, -, -) and a matrix apart.
FORWARD_FRAGMENT = """#version 430
struct Light { vec4 position; vec4 color; vec4 axis; vec4 cone; mat4 to_map; };
layout(std430, binding = 0) readonly buffer Lights { Light lights[]; };
uniform int count;
uniform vec3 albedo;
uniform vec3 ambient;
uniform float texel;
uniform sampler2DShadow maps;
in vec3 at;
in vec3 upright;
layout(location = 0) out vec4 out_color;

float seen(int k) {
    vec4 p = lights[k].to_map * vec4(at, 1.0);
    vec3 q = p.xyz / p.w;
    float sum = 0.0;
    for (int y = -1; y <= 1; ++y)
        for (int x = -1; x <= 1; ++x) sum += texture(maps, vec3(q.xy + vec2(x, y) * texel, q.z));
    return sum / 9.0;
}

void main() {
    vec3 n = normalize(upright);
    vec3 light = vec3(0.0);
    for (int k = 0; k < count; ++k) {
        vec3 l = lights[k].position.xyz - at;
        float range = lights[k].position.w;
        float square = dot(l, l);
        if (square >= range * range) continue;
        l *= inversesqrt(square);
        float facing = dot(n, l);
        if (facing <= 0.0) continue;
        float ramp = clamp(dot(-l, lights[k].axis.xyz) * lights[k].axis.w + lights[k].cone.x, 0.0, 1.0);
        if (ramp <= 0.0) continue;
        float ratio = square / (range * range);
        float reach = clamp(1.0 - ratio * ratio, 0.0, 1.0) / max(square, 1e-8);
        float share = facing * ramp * ramp * reach;
        if (lights[k].color.w > 0.0) share *= seen(k);
        light += lights[k].color.rgb * share;
    }
    vec3 radiance = albedo * (light / 3.14159265 + ambient);
    vec3 low = 12.92 * radiance, high = 1.055 * pow(radiance, vec3(1.0 / 2.4)) - 0.055;
    out_color = vec4(mix(high, low, lessThanEqual(radiance, vec3(0.0031308))), 1.0);
}
"""
