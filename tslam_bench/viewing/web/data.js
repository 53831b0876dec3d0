// Loads data files, each a script of one call of tslam.data, because a page on file:// may run scripts but not fetch files.
"use strict";
var tslam = { catalogue: null, _loaded: {}, _waiting: {} };

// Called by a data file. The arrays stay packed until somebody asks for them.
tslam.data = (name, header, body) => { tslam._loaded[name] = { header, body }; };

// The header and the arrays of a data file; it is loaded once.
tslam.load = (file) => {
  if (!tslam._waiting[file]) {
    tslam._waiting[file] = tslam._script(file).then(() => tslam._unpack(file));
    tslam._waiting[file].catch(() => { delete tslam._waiting[file]; });
  }
  return tslam._waiting[file];
};

tslam._script = (file) => new Promise((resolve, reject) => {
  if (tslam._loaded[file]) { resolve(); return; }
  const element = document.createElement("script");
  element.src = file;
  element.onload = () => (tslam._loaded[file] ? resolve() : reject(new Error(`${file} holds something else`)));
  element.onerror = () => reject(new Error(`${file} is missing; copy the whole folder`));
  document.head.append(element);
});

tslam._unpack = async (file) => {
  const { header, body } = tslam._loaded[file];
  delete tslam._loaded[file].body;
  const packed = Uint8Array.from(atob(body), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const arrays = {};
  for (const [key, entry] of Object.entries(header.arrays)) arrays[key] = tslam._array(bytes, entry);
  return { header, arrays };
};

// Bytes were put apart by their weight, and numbers are differences to the row above.
tslam._array = (bytes, { type, shape, start }) => {
  const kind = { u1: Uint8Array, i1: Int8Array, u2: Uint16Array, i2: Int16Array, u4: Uint32Array }[type];
  const count = shape.reduce((product, size) => product * size, 1), width = shape.length > 1 ? shape[1] : 1;
  const array = new kind(count);
  for (let k = 0; k < count; k++) {
    let value = 0;
    for (let b = 0; b < kind.BYTES_PER_ELEMENT; b++) value |= bytes[start + b * count + k] << (8 * b);
    array[k] = k >= width ? value + array[k - width] : value;
  }
  return array;
};

// One bit per entry, the first in the highest place of a byte.
tslam.bits = (bytes, count) => {
  const bits = new Uint8Array(count);
  for (let k = 0; k < count; k++) bits[k] = (bytes[k >> 3] >> (7 - (k & 7))) & 1;
  return bits;
};
