#version 330 core
// Phong 1975 as render/shade.py has it: linear light, albedo in the ambient and diffuse terms, a white highlight.
// The PHONG words are replaced by numbers before this is compiled.

in vec3 point;
in vec3 point_normal;
in vec3 point_color;
in vec2 point_uv;

struct Material { sampler2D base_color_texture; };
uniform Material material;

out vec4 srgb_color;

vec3 linear_from_srgb(vec3 srgb) {
    return mix(pow((srgb + 0.055) / 1.055, vec3(2.4)), srgb / 12.92, lessThanEqual(srgb, vec3(0.04045)));
}

vec3 srgb_from_linear(vec3 linear) {
    linear = clamp(linear, 0.0, 1.0);
    return mix(1.055 * pow(linear, vec3(1.0 / 2.4)) - 0.055, linear * 12.92, lessThanEqual(linear, vec3(0.0031308)));
}

vec3 texel(ivec2 place) {
    return linear_from_srgb(texelFetch(material.base_color_texture, place, 0).rgb);
}

// The hardware would blend sRGB values and pick a smaller copy of the texture; we blend four texels in linear light.
vec3 sample_texture(vec2 uv) {
    ivec2 last = textureSize(material.base_color_texture, 0) - 1;
    vec2 place = clamp(vec2(uv.x, 1.0 - uv.y) * vec2(last + 1) - 0.5, vec2(0.0), vec2(last));  // texel rows point up
    ivec2 low = ivec2(place);
    ivec2 high = min(low + 1, last);
    vec2 share = place - vec2(low);
    vec3 lower = mix(texel(low), texel(ivec2(high.x, low.y)), share.x);
    vec3 upper = mix(texel(ivec2(low.x, high.y)), texel(high), share.x);
    return mix(lower, upper, share.y);
}

vec3 unit(vec3 vector) {
    float squared = dot(vector, vector);
    return squared > 0.0 ? vector * inversesqrt(squared) : vec3(0.0);
}

void main() {
    vec3 albedo = point_color;
#ifdef HAS_BASE_COLOR_TEX
    albedo *= sample_texture(point_uv);
#endif
    vec3 normal = unit(point_normal);
    vec3 to_light = unit(PHONG_POSITION - point);
    vec3 to_eye = unit(-point);
    float n_l = dot(normal, to_light);
    float r_v = 2.0 * n_l * dot(normal, to_eye) - dot(to_light, to_eye);
    float highlight = n_l > 0.0 && r_v > 0.0 ? pow(max(r_v, 1e-12), PHONG_SHININESS) : 0.0;
    vec3 seen = albedo * (PHONG_AMBIENT + PHONG_DIFFUSE * max(n_l, 0.0)) + PHONG_SPECULAR * highlight;
    srgb_color = vec4(srgb_from_linear(seen), 1.0);
}
