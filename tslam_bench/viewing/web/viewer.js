// The page: choices, controls, keyboard, address.
"use strict";
(() => {
  const byId = (id) => document.getElementById(id);
  const catalogue = tslam.catalogue;
  const state = { object: "", entry: "", view: "episode", pose: -1, count: 8, colour: "error", time: 0, playing: false, speed: 1 };
  const percent = (parts) => `${((100 * parts) / catalogue.constants.recallParts).toFixed(1)} %`;
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  let stage, player = null, shapes = null, hand = null, last = 0, generation = 0, shownAt = "";

  const say = (text) => { byId("message").hidden = !text; byId("message").textContent = text; };
  const press = (buttons, chosen) => { for (const b of buttons) b.setAttribute("aria-pressed", String(b === chosen)); };
  const entryOf = (key) => catalogue.entries.find((entry) => entry.key === key);
  const own = () => entryOf(state.entry)?.objects[state.object];
  const option = (value, text) => Object.assign(document.createElement("option"), { value, textContent: text });

  // --- Choices ---

  const listObjects = () => {
    const names = [...new Set(catalogue.entries.flatMap((entry) => Object.keys(entry.objects)))].sort();
    byId("object").replaceChildren(...names.map((name) => option(name, name)));
    return names;
  };

  const listEntries = () => {
    const entries = catalogue.entries.filter((entry) => entry.objects[state.object]);
    byId("entry").replaceChildren(...entries.map((entry) => {
      const remark = entry.remark ? ` (${entry.remark})` : "";
      return option(entry.key, `${entry.explorer} · ${entry.reconstructor}${remark}`);
    }));
    if (!entries.some((entry) => entry.key === state.entry)) state.entry = entries[0]?.key ?? "";
    byId("object").value = state.object;
    byId("entry").value = state.entry;
  };

  // Reads the address: #object=mug&entry=...&view=shape&pose=2&step=50&count=8&colour=plain
  const readAddress = () => {
    const given = new URLSearchParams(location.hash.slice(1)), names = listObjects();
    state.object = names.includes(given.get("object")) ? given.get("object") : state.object || names[0];
    state.entry = given.get("entry") ?? state.entry;
    if (["shape", "episode"].includes(given.get("view"))) state.view = given.get("view");
    if (["plain", "error"].includes(given.get("colour"))) state.colour = given.get("colour");
    if (/^[0-7]$/.test(given.get("pose") ?? "")) state.pose = Number(given.get("pose"));
    if (/^[1-8]$/.test(given.get("count") ?? "")) state.count = Number(given.get("count"));
    if (/^\d{1,3}$/.test(given.get("step") ?? "")) state.time = Math.min(Number(given.get("step")), catalogue.constants.horizon);
    state.playing = !given.has("step") && !calm;
  };

  const writeAddress = () => {
    const parts = { object: state.object, entry: state.entry, view: state.view };
    if (state.view === "episode") parts.pose = state.pose;
    else Object.assign(parts, { count: state.count, colour: state.colour });
    shownAt = `#${new URLSearchParams(parts)}`;
    try { history.replaceState(null, "", shownAt); } catch { /* some browsers forbid it on file:// */ }
  };

  // --- Loading ---

  const show = async () => {
    const mine = ++generation;
    byId("main").setAttribute("aria-busy", "true");
    listEntries();
    const files = own();
    byId("main").dataset.view = state.view;
    press(document.querySelectorAll("[data-view][type=button]"), document.querySelector(`button[data-view="${state.view}"]`));
    if (!files) { say(state.object ? `There is nothing of ${state.object}.` : "There is nothing to show: no object is prepared on the machine that wrote this page."); return; }
    const notes = [];
    if (catalogue.missing.length) notes.push(`Left out, as they are not prepared: ${catalogue.missing.join(", ")}.`);
    if (!catalogue.hand && state.view === "episode") notes.push("The hand is not drawn: its model was not prepared on the machine that wrote this page.");
    say("Loading ...");
    try {
      const truth = await tslam.load(catalogue.truth[state.object]);
      truth.geometry ??= tslam.creasedGeometry(truth.arrays.v, truth.arrays.f, catalogue.constants.lengthStep);
      if (state.view === "shape") await showShapes(truth, files, mine);
      else await showEpisode(truth, files, mine);
      if (mine === generation) { say(notes.join(" ")); writeAddress(); byId("main").setAttribute("aria-busy", "false"); }
    } catch (error) {
      if (mine === generation) say(String(error.message ?? error));
      console.error(error);
    }
  };

  const showEpisode = async (truth, files, mine) => {
    if (!files.episodes) { state.view = "shape"; await show(); return; } // a reference that did not explore
    const data = await tslam.load(files.episodes);
    if (catalogue.hand && !hand) hand = new tslam.Hand(await tslam.load(catalogue.hand));
    if (mine !== generation) return;
    const fresh = player?.data !== data;
    tslam.paint(truth.geometry, null);
    if (fresh) { player = new tslam.Player(hand, truth.geometry, data); player.data = data; }
    const poses = player.poses.map((entry) => entry.pose);
    if (!poses.includes(state.pose)) state.pose = poses[0];
    byId("poses").replaceChildren(...Array.from({ length: 8 }, (_, pose) => {
      const button = Object.assign(document.createElement("button"), { type: "button", textContent: String(pose), disabled: !poses.includes(pose) });
      button.title = poses.includes(pose) ? `pose ${pose}` : `pose ${pose}: no episode`;
      button.addEventListener("click", () => choosePose(pose));
      return button;
    }));
    stage.show([{ element: byId("world"), scene: player.scene }]);
    if (fresh || shapes) stage.home({ azimuth: 40, elevation: 22, radius: 0.2, target: [0, -0.045, 0.035] });
    shapes = null;
    choosePose(state.pose, state.time);
    player.truth.visible = byId("show-true").checked;
  };

  const choosePose = (pose, time = 0) => {
    state.pose = pose;
    player.choose(pose);
    press(byId("poses").children, byId("poses").children[pose]);
    player.earlier.visible = byId("show-earlier").checked;
    const { source, note } = player.episode;
    const words = { live: "Simulated just now, step by step.", replayed: "", interpolated: "" };
    byId("source").textContent = [words[source], note].filter(Boolean).join(" ");
    byId("source").dataset.source = source;
    byId("world-caption").textContent = `${state.object}, pose ${pose}`;
    const line = (id, values) => byId(id).setAttribute("points", Array.from(values, (v, k) => `${k},${(100 - (100 * v) / catalogue.constants.recallParts).toFixed(2)}`).join(" "));
    for (const suffix of ["", "-all"]) { line(`alone${suffix}`, player.alone); line(`merged${suffix}`, player.merged); }
    seek(time);
    setPlaying(state.playing);
    writeAddress();
  };

  const seek = (time) => {
    const { horizon, seconds } = catalogue.constants;
    state.time = Math.min(Math.max(time, 0), horizon);
    const now = player.seek(state.time), step = Math.floor(state.time);
    byId("step").value = String(step);
    byId("step").setAttribute("aria-valuetext", `step ${step} of ${horizon}, ${percent(now.alone)} of the surface felt`);
    byId("clock").textContent = `${(state.time * seconds).toFixed(1)} s`;
    byId("f-step").textContent = `${step} of ${horizon}`;
    byId("f-touched").textContent = String(now.touched);
    byId("f-recall").textContent = percent(now.alone);
    byId("f-merged").textContent = percent(now.merged);
    byId("until-box").setAttribute("width", String(state.time));
    for (const end of ["x1", "x2"]) byId("now").setAttribute(end, String(state.time));
    stage.draw();
  };

  const setPlaying = (on) => {
    state.playing = on;
    byId("play").textContent = on ? "❚❚" : "▶";
    byId("play").setAttribute("aria-label", on ? "Stop" : "Play");
    last = 0;
    if (on) requestAnimationFrame(tick);
  };

  const tick = (now) => {
    if (!state.playing || state.view !== "episode" || !player) return;
    const passed = last ? Math.min((now - last) / 1000, 0.1) : 0;
    const { horizon, seconds } = catalogue.constants;
    if (last === now) { requestAnimationFrame(tick); return; }
    last = now;
    const time = state.time + (passed * state.speed) / seconds;
    if (time < horizon) { seek(time); requestAnimationFrame(tick); return; }
    seek(horizon);
    const place = player.poses.findIndex((entry) => entry.pose === state.pose);
    if (byId("go-on").checked && place + 1 < player.poses.length) choosePose(player.poses[place + 1].pose);
    else setPlaying(false);
  };

  // --- Shapes ---

  const showShapes = async (truth, files, mine) => {
    const data = await tslam.load(files.shape);
    if (mine !== generation) return;
    setPlaying(false);
    const first = shapes === null;
    shapes = { data, truth };
    const counts = data.header.counts.map((entry) => entry.count);
    if (!counts.includes(state.count)) state.count = counts[counts.length - 1];
    byId("counts").replaceChildren(...counts.map((count) => {
      const button = Object.assign(document.createElement("button"), { type: "button", textContent: String(count) });
      button.dataset.count = String(count);
      button.addEventListener("click", () => { state.count = count; drawShapes(); writeAddress(); });
      return button;
    }));
    drawShapes();
    truth.geometry.computeBoundingSphere();
    const { center, radius } = truth.geometry.boundingSphere;
    if (first) stage.home({ azimuth: -60, elevation: 25, radius: 1.1 * radius, target: center.toArray() });
  };

  const scene = (name, ...members) => {
    shapes.scenes ??= {};
    shapes.scenes[name] ??= new THREE.Scene();
    const kept = shapes.scenes[name];
    for (const old of kept.userData.shown ?? []) { kept.remove(old); old.material.dispose(); old.dispose?.(); }
    kept.userData.shown = members;
    kept.add(...members);
    return kept;
  };

  const drawShapes = () => {
    const { header, arrays } = shapes.data, count = state.count, scale = Number(byId("scale").value);
    const entry = header.counts.find((item) => item.count === count), coloured = state.colour === "error";
    press(byId("counts").children, [...byId("counts").children].find((b) => b.dataset.count === String(count)));
    press(document.querySelectorAll("[data-colour]"), document.querySelector(`[data-colour="${state.colour}"]`));
    byId("counts-unit").textContent = count === 1 ? "pose" : "poses";
    const voxels = tslam.voxelMesh(arrays[`t${count}`], new THREE.MeshStandardMaterial({ color: 0xe06f1f, roughness: 0.8 }));
    const rebuilt = [];
    shapes.geometry ??= {};
    if (arrays[`b${count}`]) {
      const bits = () => tslam.bits(arrays[`b${count}`], entry.nodes ** 3);
      shapes.geometry[count] ??= arrays[`p${count}`]
        ? tslam.netGeometry(bits(), entry.nodes, arrays[`p${count}`]) : tslam.blockGeometry(bits(), entry.nodes);
      tslam.paint(shapes.geometry[count], coloured ? arrays[`e${count}`] : null, 1, scale);
      rebuilt.push(new THREE.Mesh(shapes.geometry[count], new THREE.MeshStandardMaterial({ color: coloured ? 0xffffff : 0x4a87db, vertexColors: coloured, roughness: 0.75 })));
    }
    // Where the true surface lies outside the rebuilt solid, that one stays short.
    tslam.paint(shapes.truth.geometry, coloured ? arrays[`m${count}`] ?? null : null, -1, scale);
    const painted = Boolean(shapes.truth.geometry.getAttribute("color"));
    const truth = new THREE.Mesh(shapes.truth.geometry, new THREE.MeshStandardMaterial({ color: painted ? 0xffffff : 0xb3b8c2, vertexColors: painted, roughness: 0.75 }));
    const places = { touched: [voxels], rebuilt, true: [truth] };
    stage.show(Object.entries(places).map(([name, members]) => ({ element: byId(name), scene: scene(name, ...members) })));
    byId("legend").hidden = byId("scale-label").hidden = !coloured;
    byId("less").textContent = `short by ${1000 * scale} mm`;
    byId("more").textContent = `beyond by ${1000 * scale} mm`;
    byId("f-iou").textContent = entry.iou.toFixed(3);
    byId("f-felt").textContent = `${(100 * entry.recall).toFixed(1)} %`;
    byId("f-middle").textContent = entry.middle === undefined ? "–" : `${(1000 * entry.middle).toFixed(1)} mm`;
    byId("touched-figure").textContent = `${arrays[`t${count}`].length} voxels`;
    byId("rebuilt-figure").textContent = entry.reason || `IoU ${entry.iou.toFixed(3)}`;
    byId("reason").textContent = entry.reason ? `Counts as empty: ${entry.reason}.` : "";
  };

  const drawRamp = () => {
    const ramp = byId("ramp"), pen = ramp.getContext("2d");
    for (let x = 0; x < ramp.width; x++) {
      pen.fillStyle = `rgb(${tslam.errorColour((2 * x) / (ramp.width - 1) - 1, 1).map((c) => Math.round(255 * c))})`;
      pen.fillRect(x, 0, 1, ramp.height);
    }
  };

  const drawAxes = () => {
    const make = (name, attributes, text = "") => {
      const element = document.createElementNS("http://www.w3.org/2000/svg", name);
      for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
      element.textContent = text;
      return element;
    };
    for (const y of [0, 25, 50, 75, 100]) byId("axes").append(make("line", { class: "grid", x1: 0, x2: 200, y1: 100 - y, y2: 100 - y }), make("text", { x: -5, y: 103 - y, "text-anchor": "end" }, String(y)));
    for (const x of [0, 50, 100, 150, 200]) byId("axes").append(make("text", { x, y: 113, "text-anchor": "middle" }, String(x)));
  };

  // --- Controls and keyboard ---

  const setView = (view) => { if (view !== state.view) { state.view = view; show(); } };
  const toggle = (id) => { byId(id).checked = !byId(id).checked; byId(id).dispatchEvent(new Event("change")); };
  const setColour = (colour) => { state.colour = colour; if (state.view === "shape" && shapes) { drawShapes(); writeAddress(); } };
  const playOrStop = () => {
    if (!state.playing && state.time >= catalogue.constants.horizon) seek(0);
    setPlaying(!state.playing);
  };

  const listen = () => {
    byId("choice").addEventListener("submit", (event) => event.preventDefault());
    byId("object").addEventListener("change", (event) => { Object.assign(state, { object: event.target.value, time: 0 }); shapes = null; show(); });
    byId("entry").addEventListener("change", (event) => { Object.assign(state, { entry: event.target.value, time: 0 }); show(); });
    for (const button of document.querySelectorAll("button[data-view]")) button.addEventListener("click", () => setView(button.dataset.view));
    for (const button of document.querySelectorAll("[data-colour]")) button.addEventListener("click", () => setColour(button.dataset.colour));
    byId("scale").addEventListener("change", drawShapes);
    byId("play").addEventListener("click", playOrStop);
    byId("step").addEventListener("input", (event) => { setPlaying(false); seek(Number(event.target.value)); });
    byId("speed").addEventListener("change", (event) => { state.speed = Number(event.target.value); });
    byId("show-true").addEventListener("change", (event) => { if (player) player.truth.visible = event.target.checked; stage.draw(); });
    byId("show-earlier").addEventListener("change", (event) => { if (player) player.earlier.visible = event.target.checked; stage.draw(); });
    byId("fade").addEventListener("change", (event) => { hand?.fade(event.target.checked); stage.draw(); });
    window.addEventListener("hashchange", () => { if (location.hash !== shownAt) { readAddress(); shapes = null; show(); } });
    document.addEventListener("keydown", onKey);
  };

  const onKey = (event) => {
    const { target, key } = event;
    if (event.ctrlKey || event.metaKey || event.altKey || target.tagName === "SELECT") return;
    const episode = state.view === "episode" && player;
    const turns = { ArrowLeft: [-8, 0], ArrowRight: [8, 0], ArrowUp: [0, -8], ArrowDown: [0, 8] };
    if (key in turns) { if (target.type === "range") return; stage.turn(...turns[key]); }
    else if (key === "+" || key === "=") stage.turn(0, 0, 1.12);
    else if (key === "-") stage.turn(0, 0, 1 / 1.12);
    else if (key === " " && episode && !["BUTTON", "SUMMARY"].includes(target.tagName) && target.type !== "checkbox") playOrStop();
    else if ((key === "," || key === ".") && episode) { setPlaying(false); seek(Math.floor(state.time) + (key === "." ? 1 : -1)); }
    else if (/^[0-7]$/.test(key) && episode) byId("poses").children[Number(key)].click();
    else if (/^[eE]$/.test(key)) setView("episode");
    else if (/^[sS]$/.test(key)) setView("shape");
    else if (/^[cC]$/.test(key)) setColour(state.colour === "error" ? "plain" : "error");
    else if (/^[oO]$/.test(key) && episode) toggle("show-true");
    else if (/^[rR]$/.test(key)) stage.reset();
    else return;
    event.preventDefault();
  };

  if (!catalogue) { say("catalogue.js is missing; copy the whole folder."); return; }
  document.title = byId("title").textContent = catalogue.title;
  if (typeof DecompressionStream === "undefined") { say("This browser is too old: it has no DecompressionStream. Firefox 113, Chrome 80 and Safari 16.4 have it."); return; }
  try { stage = new tslam.Stage(byId("stage")); } catch { say("This browser has no WebGL, so nothing can be drawn in 3D."); return; }
  Object.assign(tslam, { state, stage, player: () => player }); // for tests and the console
  drawRamp();
  drawAxes();
  listen();
  readAddress();
  show();
})();
