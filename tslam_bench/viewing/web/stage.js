// One canvas behind several panels, one camera for all: who turns one model turns them all.
"use strict";
{
  const FIELD = 32;

  tslam.Stage = class {
    // `element` holds the panels; a canvas is put behind them.
    constructor(element) {
      this.element = element;
      this.renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true, powerPreference: "low-power" });
      this.renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
      this.renderer.setScissorTest(true);
      this.renderer.domElement.setAttribute("aria-hidden", "true");
      element.prepend(this.renderer.domElement);
      this.camera = new THREE.PerspectiveCamera(FIELD, 1, 0.01, 10);
      this.camera.up.set(0, 0, 1);
      this.controls = new THREE.OrbitControls(this.camera, element);
      this.controls.enablePan = false;
      element.style.touchAction = "pan-y"; // a finger that goes up or down scrolls the page, else it turns the model
      this.controls.rotateSpeed = 0.8;
      this.controls.minDistance = 0.08;
      this.controls.maxDistance = 3;
      this.controls.addEventListener("change", () => this.draw());
      this.panels = [];
      this._home = { azimuth: -60, elevation: 25, radius: 0.15, target: [0, 0, 0] };
      this.frames = 0;
      new ResizeObserver(() => this.draw()).observe(element);
    }

    // Panels are {element, scene}; a scene gets its lights here.
    show(panels) {
      this.panels = panels;
      for (const { scene } of panels) {
        if (scene.userData.lamp) continue;
        scene.add(new THREE.HemisphereLight(0xffffff, 0xa8adb5, 1.7));
        scene.userData.lamp = new THREE.DirectionalLight(0xffffff, 2.1);
        scene.add(scene.userData.lamp, scene.userData.lamp.target);
      }
      this.draw();
    }

    // Where the camera stands when nobody moved it: angles in degrees, radius (m) of what has to be seen around the target.
    home(view) {
      this._home = { ...this._home, ...view };
      this.reset();
    }

    reset() {
      const { azimuth, elevation, radius, target } = this._home, turn = Math.PI / 180;
      const panel = this.panels[0]?.element.getBoundingClientRect();
      const aspect = panel && panel.height ? Math.min(panel.width / panel.height, 1) : 1;
      const far = radius / Math.sin((FIELD / 2) * turn) / aspect;
      const flat = Math.cos(elevation * turn);
      this.controls.target.set(...target);
      this.camera.position.set(flat * Math.cos(azimuth * turn), flat * Math.sin(azimuth * turn), Math.sin(elevation * turn));
      this.camera.position.multiplyScalar(far).add(this.controls.target);
      this.controls.update();
      this.draw();
    }

    // Turns by degrees and zooms by a factor, for the keyboard.
    turn(sideways, up, nearer = 1) {
      const offset = this.camera.position.clone().sub(this.controls.target);
      const along = new THREE.Quaternion().setFromUnitVectors(this.camera.up, new THREE.Vector3(0, 1, 0));
      const angles = new THREE.Spherical().setFromVector3(offset.applyQuaternion(along));
      angles.theta += (sideways * Math.PI) / 180;
      angles.phi = Math.min(Math.max(angles.phi + (up * Math.PI) / 180, 0.02), Math.PI - 0.02);
      angles.radius = Math.min(Math.max(angles.radius / nearer, this.controls.minDistance), this.controls.maxDistance);
      offset.setFromSpherical(angles).applyQuaternion(along.invert());
      this.camera.position.copy(this.controls.target).add(offset);
      this.controls.update();
      this.draw();
    }

    // Draws with the next frame of the screen, however often it is called before.
    draw() {
      if (this._waiting) return;
      this._waiting = true;
      requestAnimationFrame(() => { this._waiting = false; this._render(); });
    }

    _render() {
      const whole = this.element.getBoundingClientRect();
      if (!whole.width || !whole.height) return;
      this.renderer.setSize(whole.width, whole.height);
      this.renderer.setScissor(0, 0, whole.width, whole.height);
      this.renderer.setClearColor(0, 0);
      this.renderer.clear();
      for (const { element, scene } of this.panels) {
        const place = element.getBoundingClientRect();
        if (!place.width || !place.height) continue;
        this.camera.aspect = place.width / place.height;
        this.camera.updateProjectionMatrix();
        const side = new THREE.Vector3(-0.5, 0.7, 0.6).applyQuaternion(this.camera.quaternion);
        scene.userData.lamp.position.copy(this.controls.target).add(side);
        scene.userData.lamp.target.position.copy(this.controls.target);
        const view = [place.left - whole.left, whole.bottom - place.bottom, place.width, place.height];
        this.renderer.setViewport(...view);
        this.renderer.setScissor(...view);
        this.renderer.render(scene, this.camera);
      }
      this.frames++;
    }
  };
}
