// One episode: the hand, what it touched so far, and the object that it cannot see.
"use strict";
{
  const TOUCHED = new THREE.Color(0xe06f1f), FRESH = new THREE.Color(0xfff0a0), EARLIER = 0x7d93b5, TRUE = 0xa9afb9;
  const FADES = 10; // control steps in which a touch stops to glow

  tslam.Player = class {
    // `hand` is a tslam.Hand or null, `truth` the geometry of the object.
    constructor(hand, truth, { header, arrays }) {
      this.scene = new THREE.Scene();
      this.poses = header.poses;
      this.hand = hand;
      this._arrays = arrays;
      if (hand) this.scene.add(hand.root);
      const { edge } = tslam.catalogue.constants;
      const frame = new THREE.EdgesGeometry(new THREE.BoxGeometry(edge, edge, edge));
      this.scene.add(new THREE.LineSegments(frame, new THREE.LineBasicMaterial({ color: 0x8a94a3, transparent: true, opacity: 0.35 })));
      this.object = new THREE.Group();
      this.scene.add(this.object);
      const glass = { color: TRUE, roughness: 0.6, transparent: true, opacity: 0.3, depthWrite: false };
      this.truth = new THREE.Mesh(truth, new THREE.MeshStandardMaterial(glass));
      this.truth.renderOrder = 2;
      this.object.add(this.truth);
      this._plain = new THREE.MeshStandardMaterial({ roughness: 0.8 });
      this._dim = new THREE.MeshStandardMaterial({ color: EARLIER, roughness: 0.9 });
      this._positions = new Float32Array(28);
    }

    // Begins the episode of a pose; earlier ones in the order of exploration lend their touches.
    choose(pose) {
      const place = this.poses.findIndex((entry) => entry.pose === pose);
      this.episode = this.poses[place];
      const get = (key) => this._arrays[key + pose];
      Object.assign(this, { voxels: get("x"), steps: get("s"), alone: get("r"), merged: get("m"), joints: get("q"), felt: get("t") });
      const before = new Set();
      for (const earlier of this.poses.slice(0, place)) for (const voxel of this._arrays[`x${earlier.pose}`]) before.add(voxel);
      if (this.earlier) { this.object.remove(this.earlier, this.now); this.earlier.dispose(); this.now.dispose(); }
      this.earlier = tslam.voxelMesh([...before], this._dim);
      this.now = tslam.voxelMesh(this.voxels, this._plain);
      this.now.scale.setScalar(1.0005); // where both are, this one is seen
      this.object.add(this.earlier, this.now);
      this.object.quaternion.copy(tslam.poseRotation(pose));
    }

    // Shows the state after `time` control steps; between two the hand is in between.
    seek(time) {
      const { joints: range, horizon } = tslam.catalogue.constants;
      const step = Math.min(Math.floor(time), horizon), next = Math.min(step + 1, horizon), share = time - step;
      for (let k = 0; k < 28; k++) {
        const value = (this.joints[28 * step + k] * (1 - share) + this.joints[28 * next + k] * share) / 65535;
        this._positions[k] = range[k][0] + value * (range[k][1] - range[k][0]);
      }
      let count = 0;
      while (count < this.steps.length && this.steps[count] < step) count++;
      this.now.count = count;
      const colour = new THREE.Color();
      for (let k = 0; k < count; k++) {
        const glow = Math.max(0, 1 - (time - 1 - this.steps[k]) / FADES);
        this.now.setColorAt(k, colour.copy(TOUCHED).lerp(FRESH, glow));
      }
      if (this.now.instanceColor) this.now.instanceColor.needsUpdate = true;
      if (this.hand) {
        this.hand.move(this._positions);
        this.hand.light((link) => this._glow(link, step));
      }
      return { touched: count, alone: this.alone[step], merged: this.merged[step] };
    }

    // 1 while a link touches, less after it let go.
    _glow(link, step) {
      if (!this.felt) return 0;
      const width = this.felt.length / tslam.catalogue.constants.horizon;
      for (let back = 0; back < 5 && step - 1 - back >= 0; back++) {
        if ((this.felt[(step - 1 - back) * width + (link >> 3)] >> (7 - (link & 7))) & 1) return 1 - back / 5;
      }
      return 0;
    }
  };
}
