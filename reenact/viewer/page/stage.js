// The stage: faces side by side on one canvas, one camera for all, lit as render/shade.py lights them.

import {
  BufferAttribute, BufferGeometry, DoubleSide, Mesh, PerspectiveCamera, Scene, ShaderMaterial, SRGBColorSpace,
  TextureLoader, Vector3, WebGLRenderer,
} from "./vendor/three.module.min.js";
import { OrbitControls } from "./vendor/OrbitControls.js";
import { distances } from "./face.js";

/** Looking from: degrees around the head. */
export const VIEWS = { front: 0, "three-quarter": 38, side: 88 };

/** Pixels of the picture along each pixel of the page, where there is no card. */
export const DETAIL = { playing: 0.7, moving: 1, still: 2 };

const ROOM = 1.42; // how much more is seen than a portrait shows: chin, hair and ears
const MIDDLE = new Vector3(0, 0.016, -0.04); // of what is looked at, metres

// Phong 1975, as render/shade.py has it; the light goes with the eye. Where there is no card it is worked out for vertices
// instead of pixels, which takes half the time and is hard to tell apart on meshes this fine.
const SHADING = `
#ifdef PER_VERTEX
vec3 point, surface;
float error;
#else
varying vec3 point, surface;
varying float error;
#endif
varying vec3 albedo;
varying vec2 place;
uniform bool textured, heated, lines;
uniform float scale;
uniform vec3 ink;
vec3 ramp(float t) {
  vec3 low = mix(vec3(0.60, 0.59, 0.57), vec3(0.95, 0.49, 0.07), smoothstep(0.0, 0.4, t));
  return mix(low, mix(vec3(0.68, 0.03, 0.03), vec3(0.12, 0.0, 0.06), smoothstep(0.7, 1.0, t)), smoothstep(0.35, 0.75, t));
}
vec3 lit(vec3 color, vec3 point, vec3 surface) {
  vec3 normal = normalize(surface), to_light = normalize(vec3(0.15, 0.35, -0.05) - point), to_eye = normalize(-point);
  float n_l = dot(normal, to_light), r_v = 2.0 * n_l * dot(normal, to_eye) - dot(to_light, to_eye);
  float highlight = n_l > 0.0 && r_v > 0.0 ? r_v * r_v : 0.0;
  highlight *= highlight, highlight *= highlight, highlight *= highlight;  // to the 16th
  return color * (0.25 + 0.75 * max(n_l, 0.0)) + (heated ? 0.0 : 0.05) * highlight;
}
vec3 srgb(vec3 c) {
  c = clamp(c, 0.0, 1.0);
  return mix(1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, c * 12.92, vec3(lessThanEqual(c, vec3(0.0031308))));
}`;

const VERTEX = `${SHADING}
attribute vec3 tint;
attribute float heat;
void main() {
  vec4 seen = modelViewMatrix * vec4(position, 1.0);
  point = seen.xyz;
  surface = normalMatrix * normal;
  albedo = tint;
  error = heat;
  place = uv;
  gl_Position = projectionMatrix * seen;
#ifdef PER_VERTEX
  albedo = lines && !heated ? ink : lit(heated ? ramp(clamp(heat / scale, 0.0, 1.0)) : tint, point, surface);
  if (heated || !(lines || textured)) albedo = srgb(albedo);
#endif
}`;

const FRAGMENT = `${SHADING}
uniform sampler2D map;
void main() {
#ifdef PER_VERTEX
  gl_FragColor = vec4(textured && !heated && !lines ? sqrt(albedo * texture2D(map, place).rgb) : albedo, 1.0);
#else
  vec3 color = albedo;
  if (textured) color *= texture2D(map, place).rgb;
  if (heated) color = ramp(clamp(error / scale, 0.0, 1.0));
  gl_FragColor = vec4(lines && !heated ? ink : srgb(lit(color, point, surface)), 1.0);
#endif
}`;

export class Stage {
  constructor(canvas, framing, changed) {
    this.canvas = canvas;
    this.software = drawsInSoftware();
    this.renderer = new WebGLRenderer({ canvas, antialias: !this.software, powerPreference: "high-performance" });
    this.renderer.outputColorSpace = SRGBColorSpace;
    this.renderer.setScissorTest(true);
    this.halfHeight = framing.half_height * ROOM;
    this.distance = framing.distance;
    this.camera = new PerspectiveCamera(30, 1, 0.05, 20);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.minDistance = 0.15;
    this.controls.maxDistance = 3;
    this.controls.addEventListener("change", changed);
    this.cells = [];
    this.columns = 1;
    this.detail = DETAIL.moving;
    this.look("front");
  }

  /** Turns the camera to one of `VIEWS`, at its first distance. */
  look(view) {
    const angle = (VIEWS[view] * Math.PI) / 180;
    this.controls.target.copy(MIDDLE);
    this.camera.position.set(Math.sin(angle), 0, Math.cos(angle)).multiplyScalar(this.distance).add(MIDDLE);
    this.controls.update();
  }

  /** Turns and nears the camera by the keyboard: radians around, radians up, factor of the distance. */
  turn(around, up, nearer = 1) {
    const arm = this.camera.position.clone().sub(this.controls.target);
    const length = Math.min(Math.max(arm.length() * nearer, this.controls.minDistance), this.controls.maxDistance);
    const side = Math.atan2(arm.x, arm.z) + around;
    const height = Math.min(Math.max(Math.asin(arm.y / arm.length()) + up, -1.4), 1.4);
    arm.set(Math.sin(side) * Math.cos(height), Math.sin(height), Math.cos(side) * Math.cos(height));
    this.camera.position.copy(this.controls.target).addScaledVector(arm, length);
    this.controls.update();
  }

  /** As many columns as make the faces largest. */
  resize(count) {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    let best = 0;
    for (let columns = 1; columns <= Math.max(count, 1); columns++) {
      const rows = Math.ceil(count / columns);
      const size = Math.min((width / columns) * 1.15, height / rows);
      if (size > best * 1.001) [best, this.columns] = [size, columns];
    }
    this.rows = Math.ceil(count / this.columns) || 1;
    this.renderer.setPixelRatio(this.software ? this.detail : Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    const aspect = width / this.columns / (height / this.rows);
    const half = this.halfHeight / Math.min(1, aspect * 1.15); // a narrow cell shows the width of a head
    this.camera.fov = (2 * Math.atan(half / this.distance) * 180) / Math.PI;
    this.camera.aspect = aspect;
    this.camera.updateProjectionMatrix();
  }

  /** Without a card: coarse while the clip plays, smooth once it stands still. */
  setDetail(detail) {
    if (!this.software || this.detail === detail) return;
    this.detail = detail;
    this.renderer.setPixelRatio(detail);
  }

  add(face, texture) {
    const cell = new Cell(face, texture, this.software);
    this.cells.push(cell);
    return cell;
  }

  remove(cell) {
    this.cells = this.cells.filter((other) => other !== cell);
    cell.dispose();
  }

  draw() {
    const { renderer, columns, rows } = this;
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    const width = clientWidth / columns, height = clientHeight / rows;
    this.cells.forEach((cell, n) => {
      const x = (n % columns) * width, y = (rows - 1 - Math.floor(n / columns)) * height;
      renderer.setViewport(x, y, width, height);
      renderer.setScissor(x, y, width, height);
      if (this.software) cell.leaveOut(this.detail === DETAIL.playing ? this.camera.position : null);
      renderer.render(cell.scene, this.camera);
    });
  }

  paint({ background, ink, wireframe, scale }) {
    this.renderer.setClearColor(background);
    for (const { material } of this.cells) {
      material.wireframe = material.uniforms.lines.value = wireframe;
      material.uniforms.scale.value = scale;
      material.uniforms.ink.value.set(...ink);
    }
  }

  /** Waits until the card has drawn all of it. */
  finish() {
    const gl = this.renderer.getContext();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }
}

class Cell {
  constructor(face, texture, perVertex) {
    this.face = face;
    this.positions = new Float32Array(face.neutral.length);
    this.normals = new Float32Array(face.neutral.length);
    this.heat = new Float32Array(face.vertexCount);
    this.others = null;
    const drawn = face.corners?.length ?? face.vertexCount;
    const spread = (array, size) => (face.corners ? scattered(face.corners, array, new array.constructor(drawn * size), size) : array);
    this.drawn = face.corners
      ? { position: new Float32Array(3 * drawn), normal: new Float32Array(3 * drawn), heat: new Float32Array(drawn) }
      : { position: this.positions, normal: this.normals, heat: this.heat };
    const geometry = new BufferGeometry();
    this.index = this.whole = new BufferAttribute(face.triangles, 1);
    this.part = null; // of the triangles, while the clip plays
    geometry.setIndex(this.index);
    geometry.setAttribute("position", new BufferAttribute(this.drawn.position, 3));
    geometry.setAttribute("normal", new BufferAttribute(this.drawn.normal, 3));
    geometry.setAttribute("heat", new BufferAttribute(this.drawn.heat, 1));
    geometry.setAttribute("tint", new BufferAttribute(spread(Float32Array.from(face.colors, linear), 3), 3));
    geometry.setAttribute("uv", new BufferAttribute(face.uv ?? new Float32Array(2 * drawn), 2));
    this.material = new ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      side: DoubleSide,
      defines: perVertex ? { PER_VERTEX: "" } : {},
      uniforms: {
        map: { value: texture },
        textured: { value: texture !== null },
        heated: { value: false },
        lines: { value: false },
        scale: { value: 5 },
        ink: { value: new Vector3() },
      },
    });
    this.mesh = new Mesh(geometry, this.material);
    this.mesh.frustumCulled = false; // it bends beyond the sphere that was measured
    this.scene = new Scene();
    this.scene.add(this.mesh);
  }

  /** Takes an expression on; with other weights, colours how far it is from theirs. Returns that in millimetres. */
  pose(weights, otherWeights) {
    const { face, positions, normals, heat, drawn, mesh: { geometry } } = this;
    face.bend(weights, positions);
    face.bendNormals(positions, normals);
    let mean = null;
    if (otherWeights) {
      this.others ??= new Float32Array(positions.length);
      mean = distances(positions, face.bend(otherWeights, this.others), heat);
    }
    if (face.corners) {
      scattered(face.corners, positions, drawn.position, 3);
      scattered(face.corners, normals, drawn.normal, 3);
      if (otherWeights) scattered(face.corners, heat, drawn.heat, 1);
    }
    geometry.attributes.position.needsUpdate = true;
    geometry.attributes.normal.needsUpdate = true;
    geometry.attributes.heat.needsUpdate = Boolean(otherWeights);
    this.material.uniforms.heated.value = Boolean(otherWeights);
    return mean;
  }

  /** Draws what faces the eye only, half of a head; without an eye everything. A triangle costs even where it is not seen. */
  leaveOut(eye) {
    const { face, mesh: { geometry } } = this;
    if (this.material.wireframe) eye = null; // three.js makes lines of each index anew
    if (eye === null && this.index === this.whole) return;
    if (eye !== null) {
      this.part ??= new BufferAttribute(face.triangles.slice(), 1);
      geometry.setDrawRange(0, face.facing(this.positions, eye, this.part.array));
      this.part.needsUpdate = true;
    } else {
      geometry.setDrawRange(0, Infinity);
    }
    this.index = eye === null ? this.whole : this.part;
    geometry.setIndex(this.index);
  }

  dispose() {
    this.mesh.geometry.dispose();
    this.material.dispose();
  }
}

/** Linear light of a byte of sRGB. */
function linear(byte) {
  const value = byte / 255;
  return value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
}

export async function loadTexture(path) {
  const texture = await new TextureLoader().loadAsync(path);
  texture.flipY = false; // (0, 0) of our coordinates is the top left
  texture.colorSpace = SRGBColorSpace;
  texture.anisotropy = 4;
  return texture;
}

function scattered(corners, from, to, size) {
  for (let n = 0; n < corners.length; n++) {
    for (let axis = 0; axis < size; axis++) to[size * n + axis] = from[size * corners[n] + axis];
  }
  return to;
}

/** Whether there is no card, and smooth edges cost more than they are worth. */
function drawsInSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const extension = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = extension ? String(gl.getParameter(extension.UNMASKED_RENDERER_WEBGL)) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}
