// A rig that bends: neutral + weights x offsets, on the CPU.
//
// A frame moves some twenty shapes, each a small part of the face, so that only the vertices that a shape moves are touched;
// the same positions serve for normals and for error colours. docs/viewer.md has what this costs beside morph targets on the
// GPU.

export class Face {
  constructor(arrays) {
    this.neutral = arrays.neutral;
    this.faces = arrays.faces;
    this.outward = arrays.outward; // 1 where only the front can be seen
    this.starts = arrays.shape_starts;
    this.moved = arrays.shape_vertices;
    this.offsets = arrays.shape_offsets;
    this.colors = arrays.colors;
    // A texture cuts the surface: what is drawn are corners, several of which may lie on one vertex.
    this.corners = arrays.corners ?? null;
    this.uv = arrays.uv ?? null;
    this.triangles = arrays.triangles ?? arrays.faces;
  }

  get vertexCount() {
    return this.neutral.length / 3;
  }

  /** Vertices of an expression, written to `positions` (V x 3). */
  bend(weights, positions) {
    const { starts, moved, offsets } = this;
    positions.set(this.neutral);
    for (let shape = 0; shape < weights.length; shape++) {
      const weight = weights[shape];
      if (weight === 0) continue;
      for (let n = starts[shape], end = starts[shape + 1], from = 3 * n; n < end; n++, from += 3) {
        const to = 3 * moved[n];
        positions[to] += weight * offsets[from];
        positions[to + 1] += weight * offsets[from + 1];
        positions[to + 2] += weight * offsets[from + 2];
      }
    }
    return positions;
  }

  /** Sums of the adjoining faces' area-weighted normals, as in render/shade.py; the shader gives them their length. */
  bendNormals(positions, normals) {
    const { faces } = this;
    normals.fill(0);
    for (let n = 0; n < faces.length; n += 3) {
      const a = 3 * faces[n], b = 3 * faces[n + 1], c = 3 * faces[n + 2];
      const ax = positions[a], ay = positions[a + 1], az = positions[a + 2];
      const ux = positions[b] - ax, uy = positions[b + 1] - ay, uz = positions[b + 2] - az;
      const vx = positions[c] - ax, vy = positions[c + 1] - ay, vz = positions[c + 2] - az;
      // Scaled up: the faces of a head are some square millimetres, which float32 products would round away.
      const x = 1e6 * (uy * vz - uz * vy), y = 1e6 * (uz * vx - ux * vz), z = 1e6 * (ux * vy - uy * vx);
      normals[a] += x; normals[a + 1] += y; normals[a + 2] += z;
      normals[b] += x; normals[b + 1] += y; normals[b + 2] += z;
      normals[c] += x; normals[c + 1] += y; normals[c + 2] += z;
    }
    return normals;
  }

  /** Writes the triangles whose fronts look at `eye`, and those whose backs can be seen, to `index`; returns how many numbers. */
  facing(positions, eye, index) {
    const { faces, outward, triangles } = this;
    let count = 0;
    for (let n = 0; n < faces.length; n += 3) {
      const a = 3 * faces[n], b = 3 * faces[n + 1], c = 3 * faces[n + 2];
      const ax = positions[a], ay = positions[a + 1], az = positions[a + 2];
      const ux = positions[b] - ax, uy = positions[b + 1] - ay, uz = positions[b + 2] - az;
      const vx = positions[c] - ax, vy = positions[c + 1] - ay, vz = positions[c + 2] - az;
      const ahead = (uy * vz - uz * vy) * (eye.x - ax) + (uz * vx - ux * vz) * (eye.y - ay) + (ux * vy - uy * vx) * (eye.z - az);
      if (ahead <= 0 && outward[n / 3]) continue;
      index[count++] = triangles[n];
      index[count++] = triangles[n + 1];
      index[count++] = triangles[n + 2];
    }
    return count;
  }
}

/** Millimetres between two expressions at each vertex, and their mean. */
export function distances(positions, others, heat) {
  let total = 0;
  for (let v = 0, p = 0; v < heat.length; v++, p += 3) {
    const x = positions[p] - others[p], y = positions[p + 1] - others[p + 1], z = positions[p + 2] - others[p + 2];
    heat[v] = 1000 * Math.sqrt(x * x + y * y + z * z);
    total += heat[v];
  }
  return total / heat.length;
}
