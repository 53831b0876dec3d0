// The hand: links that hang on each other by joints, so that joint positions alone move it.
"use strict";
{
  const SKIN = 0xc9b8a8, ARM = 0x8f99a6, FELT = 0xffb020;

  const put = (object, place) => {
    object.position.set(place[0], place[1], place[2]);
    object.quaternion.set(place[3], place[4], place[5], place[6]);
  };

  tslam.Hand = class {
    // `data` is what tslam.load gave for the hand's file.
    constructor({ header, arrays }) {
      this.root = new THREE.Group();
      put(this.root, header.base);
      this._joints = [];
      this._skins = [];
      this.links = {};
      const shapes = {};
      const groups = header.links.map(() => new THREE.Group());
      header.links.forEach((link, k) => {
        const group = groups[k], above = link.parent < 0 ? this.root : groups[link.parent];
        if (link.place) {
          const joint = new THREE.Group();
          put(joint, link.place);
          above.add(joint);
          joint.add(group);
        } else above.add(group);
        if (link.joint >= 0) this._joints.push({ group, index: link.joint, type: link.type, axis: new THREE.Vector3(...link.axis) });
        const material = new THREE.MeshStandardMaterial({ color: link.skin < 0 ? ARM : SKIN, roughness: 0.75, metalness: 0 });
        for (const { mesh, place } of link.visuals) {
          shapes[mesh] ??= tslam.creasedGeometry(arrays[`v${mesh}`], arrays[`f${mesh}`], header.step);
          const shown = new THREE.Mesh(shapes[mesh], material);
          put(shown, place);
          group.add(shown);
        }
        if (link.skin >= 0) this._skins.push({ material, index: link.skin, own: new THREE.Color(SKIN), felt: new THREE.Color(FELT) });
        this.links[link.name] = group;
      });
      this._materials = groups.flatMap((group) => group.children.filter((child) => child.isMesh).map((mesh) => mesh.material));
    }

    // Moves the joints to 28 positions (m, rad).
    move(positions) {
      for (const { group, index, type, axis } of this._joints) {
        if (type === "prismatic") group.position.copy(axis).multiplyScalar(positions[index]);
        else group.quaternion.setFromAxisAngle(axis, positions[index]);
      }
    }

    // Lets links glow that touch; `glow` gives 0 to 1 for each skin link.
    light(glow) {
      for (const { material, index, own, felt } of this._skins) {
        material.color.copy(own).lerp(felt, 0.75 * glow(index));
        material.emissive.copy(felt).multiplyScalar(0.35 * glow(index));
      }
    }

    fade(seeThrough) {
      for (const material of this._materials) {
        material.transparent = seeThrough;
        material.opacity = seeThrough ? 0.35 : 1;
        material.depthWrite = !seeThrough;
        material.needsUpdate = true;
      }
    }
  };
}
