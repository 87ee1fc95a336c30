#version 330 core
// Vertices come in camera space, so that the model and view matrices are the identity and are left out.

layout(location = 0) in vec3 position;
layout(location = NORMAL_LOC) in vec3 normal;
#ifdef TEXCOORD_0_LOC
layout(location = TEXCOORD_0_LOC) in vec2 texture_position;
#endif
layout(location = COLOR_0_LOC) in vec4 linear_color;

uniform mat4 P;

out vec3 point;
out vec3 point_normal;
out vec3 point_color;
out vec2 point_uv;

void main() {
    gl_Position = P * vec4(position, 1.0);
    point = position;
    point_normal = normal;
    point_color = linear_color.rgb;
#ifdef TEXCOORD_0_LOC
    point_uv = texture_position;
#else
    point_uv = vec2(0.0);
#endif
}
