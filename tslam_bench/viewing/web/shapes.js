// From arrays to geometry, all in the object frame and in metres.
"use strict";
{
  const CREASE = Math.cos((40 * Math.PI) / 180);
  const constants = () => tslam.catalogue.constants;

  // Every corner of an indexed mesh by itself, with a normal that is smooth but not across creases.
  const creased = (position, index) => {
    const faces = index.length / 3, normals = new Float32Array(index.length), areas = new Float32Array(index.length);
    const start = new Uint32Array(position.length / 3 + 1);
    for (let f = 0; f < faces; f++) {
      const [a, b, c] = [0, 1, 2].map((k) => 3 * index[3 * f + k]);
      const u = [0, 1, 2].map((k) => position[b + k] - position[a + k]), v = [0, 1, 2].map((k) => position[c + k] - position[a + k]);
      const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      const length = Math.hypot(...n) || 1;
      for (let k = 0; k < 3; k++) { areas[3 * f + k] = n[k]; normals[3 * f + k] = n[k] / length; }
    }
    for (const corner of index) start[corner + 1]++;
    for (let v = 0; v < start.length - 1; v++) start[v + 1] += start[v];
    const around = new Uint32Array(index.length), filled = start.slice();
    for (let k = 0; k < index.length; k++) around[filled[index[k]]++] = Math.floor(k / 3);
    const corners = new Float32Array(3 * index.length), smooth = new Float32Array(3 * index.length);
    for (let k = 0; k < index.length; k++) {
      const own = 3 * Math.floor(k / 3), vertex = index[k];
      let x = 0, y = 0, z = 0;
      for (let j = start[vertex]; j < start[vertex + 1]; j++) {
        const f = 3 * around[j];
        const same = normals[own] * normals[f] + normals[own + 1] * normals[f + 1] + normals[own + 2] * normals[f + 2];
        if (same > CREASE) { x += areas[f]; y += areas[f + 1]; z += areas[f + 2]; }
      }
      const length = Math.hypot(x, y, z) || 1;
      smooth.set([x / length, y / length, z / length], 3 * k);
      corners.set(position.subarray(3 * vertex, 3 * vertex + 3), 3 * k);
    }
    return { corners, smooth };
  };

  // A mesh of creased triangles; `values` (one a vertex) can colour it later, see tslam.paint.
  tslam.creasedGeometry = (lengths, index, step) => {
    const position = Float32Array.from(lengths, (value) => value * step);
    const { corners, smooth } = creased(position, index);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(corners, 3));
    geometry.setAttribute("normal", new THREE.BufferAttribute(smooth, 3));
    geometry.userData.vertex = index;
    return geometry;
  };

  // A surface net: a vertex in each cell between lattice nodes that differ, a quad for each lattice edge that is crossed.
  tslam.netGeometry = (bits, nodes, places) => {
    const { edge, places: parts } = constants();
    const size = nodes + 1, cell = edge / nodes, stride = [size * size, size, 1];
    const solid = (x, y, z) => x >= 0 && y >= 0 && z >= 0 && x < nodes && y < nodes && z < nodes && bits[(x * nodes + y) * nodes + z];
    const number = new Int32Array(size ** 3).fill(-1), position = new Float32Array(places.length);
    let count = 0;
    for (let x = 0; x < size; x++) for (let y = 0; y < size; y++) for (let z = 0; z < size; z++) {
      let corners = 0;
      for (let k = 0; k < 8; k++) corners += solid(x - (k & 1), y - ((k >> 1) & 1), z - (k >> 2)) ? 1 : 0;
      if (corners === 0 || corners === 8) continue;
      [x, y, z].forEach((at, k) => { position[3 * count + k] = -edge / 2 + cell * (at - 0.5 + (places[3 * count + k] + 0.5) / parts); });
      number[(x * size + y) * size + z] = count++;
    }
    const index = [];
    for (let x = -1; x < nodes; x++) for (let y = -1; y < nodes; y++) for (let z = -1; z < nodes; z++) {
      const here = solid(x, y, z), at = ((x + 1) * size + y + 1) * size + z + 1;
      for (let axis = 0; axis < 3; axis++) {
        const there = solid(x + (axis === 0), y + (axis === 1), z + (axis === 2));
        if (!here === !there) continue;
        const u = stride[(axis + 1) % 3], v = stride[(axis + 2) % 3];
        const quad = [at - u - v, at - v, at, at - u].map((k) => number[k]);
        if (!here) quad.reverse();
        index.push(quad[0], quad[1], quad[2], quad[0], quad[2], quad[3]);
      }
    }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(position, 3));
    geometry.setIndex(index);
    geometry.computeVertexNormals();
    return geometry;
  };

  // The faces of solid cells; vertices are the corners that are used, in C order of the corners.
  tslam.blockGeometry = (bits, nodes) => {
    const { edge } = constants(), size = nodes + 1, cell = edge / nodes;
    const solid = (x, y, z) => x >= 0 && y >= 0 && z >= 0 && x < nodes && y < nodes && z < nodes && bits[(x * nodes + y) * nodes + z];
    const quads = [], used = new Int32Array(size ** 3).fill(-1);
    for (let x = 0; x < nodes; x++) for (let y = 0; y < nodes; y++) for (let z = 0; z < nodes; z++) {
      if (!solid(x, y, z)) continue;
      for (let axis = 0; axis < 3; axis++) for (const side of [0, 1]) {
        const step = [0, 0, 0];
        step[axis] = side ? 1 : -1;
        if (solid(x + step[0], y + step[1], z + step[2])) continue;
        const quad = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([u, v]) => {
          const corner = [x, y, z];
          corner[axis] += side;
          corner[(axis + 1) % 3] += u;
          corner[(axis + 2) % 3] += v;
          return (corner[0] * size + corner[1]) * size + corner[2];
        });
        if (!side) quad.reverse();
        quads.push(quad);
        quad.forEach((corner) => { used[corner] = 0; });
      }
    }
    const position = [];
    used.forEach((value, corner) => {
      if (value < 0) return;
      used[corner] = position.length / 3;
      position.push(...[Math.floor(corner / size ** 2), Math.floor(corner / size) % size, corner % size].map((at) => -edge / 2 + cell * at));
    });
    const index = quads.flatMap((quad) => [0, 1, 2, 0, 2, 3].map((k) => used[quad[k]]));
    const { corners, smooth } = creased(Float32Array.from(position), index);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(corners, 3));
    geometry.setAttribute("normal", new THREE.BufferAttribute(smooth, 3));
    geometry.userData.vertex = index;
    return geometry;
  };

  const MIDDLE = [0.86, 0.86, 0.84], LESS = [0.12, 0.35, 0.80], MORE = [0.80, 0.13, 0.10];
  const linear = (value) => (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);

  // Colour of an error in metres: blue where the reconstruction stays short of the true surface, red beyond it.
  tslam.errorColour = (error, scale) => {
    const share = Math.min(Math.abs(error) / scale, 1), end = error < 0 ? LESS : MORE;
    return MIDDLE.map((value, k) => value + (end[k] - value) * share ** 0.8);
  };

  // Colours a geometry by errors in stored steps, one a vertex; null takes the colours away.
  tslam.paint = (geometry, errors, sign, scale) => {
    if (!errors) { geometry.deleteAttribute("color"); return; }
    const vertex = geometry.userData.vertex, count = geometry.getAttribute("position").count;
    const step = constants().errorStep, colours = new Float32Array(3 * count);
    for (let k = 0; k < count; k++) {
      const error = sign * errors[vertex ? vertex[k] : k] * step;
      colours.set(tslam.errorColour(error, scale).map(linear), 3 * k);
    }
    geometry.setAttribute("color", new THREE.BufferAttribute(colours, 3));
  };

  // Cubes for voxels, all of them there; `count` of the mesh says how many are drawn.
  tslam.voxelMesh = (voxels, material) => {
    const { edge, grid } = constants(), cell = edge / grid;
    const mesh = new THREE.InstancedMesh(new THREE.BoxGeometry(0.88 * cell, 0.88 * cell, 0.88 * cell), material, Math.max(voxels.length, 1));
    const place = new THREE.Matrix4();
    voxels.forEach((voxel, k) => {
      const at = [Math.floor(voxel / grid ** 2), Math.floor(voxel / grid) % grid, voxel % grid].map((i) => -edge / 2 + cell * (i + 0.5));
      mesh.setMatrixAt(k, place.makeTranslation(...at));
    });
    mesh.count = voxels.length;
    mesh.frustumCulled = false;
    return mesh;
  };

  // The rotation that carries the object frame to the world of a pose.
  tslam.poseRotation = (pose) => {
    const [a, b, c] = constants().rotations[pose];
    return new THREE.Quaternion().setFromRotationMatrix(new THREE.Matrix4().set(...a, 0, ...b, 0, ...c, 0, 0, 0, 0, 1));
  };
}
