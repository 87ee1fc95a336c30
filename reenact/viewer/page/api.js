// What the page asks its server for: JSON, geometry as safetensors, weights as rows of float32.

/** The answer to a request; an Error with the server's own sentence where it refuses. */
export async function request(path, options) {
  const answer = await fetch(path, options);
  if (answer.ok) return answer;
  const said = await answer.json().catch(() => ({}));
  throw new Error(said.error ?? `${path}: the viewer answered ${answer.status}`);
}

export async function json(path) {
  return (await request(path)).json();
}

const KINDS = { F32: Float32Array, U32: Uint32Array, U8: Uint8Array };

/** Arrays of a safetensors file by name, without copying them. */
export async function tensors(path) {
  const buffer = await (await request(path)).arrayBuffer();
  const length = Number(new DataView(buffer).getBigUint64(0, true));
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length)));
  const found = {};
  for (const [name, { dtype, data_offsets: [start, end] }] of Object.entries(header)) {
    const Kind = KINDS[dtype];
    found[name] = new Kind(buffer, 8 + length + start, (end - start) / Kind.BYTES_PER_ELEMENT);
  }
  return found;
}

/** Fills `array` with float32 as it arrives; `arrived` is told how many numbers are there. */
export async function floats(path, array, arrived = () => {}, options = {}) {
  const answer = await request(path, options);
  const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
  const reader = answer.body.getReader();
  let place = 0;
  while (place < bytes.length) {
    const { done, value } = await reader.read();
    if (done) throw new Error(`${path}: the viewer stopped half way`);
    bytes.set(value, place);
    place += value.length;
    arrived(place >> 2);
  }
  await reader.read().catch(() => {}); // the end of it
}

export function post(path, body, signal) {
  return request(path, { method: "POST", body, signal });
}

/** Hands a file to the browser's downloads. */
export async function download(path, body, name) {
  const blob = await (await post(path, body)).blob();
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}
