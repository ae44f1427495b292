// The 3D view of the report: drag to turn, slider to move the joint, or the video moves it. `view` comes from model3d.py.
async function startModel(view, packed, film) {
  const raw = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const stream = new Blob([raw(packed)]).stream().pipeThrough(new DecompressionStream("gzip"));
  const code = document.createElement("script");
  code.textContent = await new Response(stream).text();
  document.head.append(code);

  const place = document.getElementById("model"), slider = document.getElementById("state");
  const words = document.getElementById("state-words"), follow = document.getElementById("follow");
  const q = new Float32Array(raw(view.q)), time = new Float32Array(raw(view.time));
  const hand = view.hand ? new Float32Array(raw(view.hand)) : null;
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;

  function link(data, name) {
    const xyz = new Float32Array(raw(data.xyz)), ijk = new Uint32Array(raw(data.ijk)), rgb = new Uint8Array(raw(data.rgb));
    const pick = (array, k) => array.filter((_, n) => n % 3 === k);
    const colours = [];
    for (let n = 0; n < rgb.length; n += 3) colours.push(`rgb(${rgb[n]},${rgb[n + 1]},${rgb[n + 2]})`);
    return { type: "mesh3d", name, x: pick(xyz, 0), y: pick(xyz, 1), z: pick(xyz, 2), i: pick(ijk, 0), j: pick(ijk, 1),
             k: pick(ijk, 2), vertexcolor: colours, hoverinfo: "name", flatshading: true,
             lighting: { ambient: 0.75, diffuse: 0.5, specular: 0.05, roughness: 0.9 } };
  }
  const moving = link(view.links.moving, "moving part");
  const rest = [moving.x, moving.y, moving.z];
  const line = (points, name, color, width) => ({ type: "scatter3d", mode: "lines", name, hoverinfo: "name",
    x: points.map((p) => p[0]), y: points.map((p) => p[1]), z: points.map((p) => p[2]), line: { color, width } });

  function pose(state) {  // Rodrigues about the axis through the point, and the slide along it
    const [a, b, c] = view.axis, turn = view.kind === "prismatic" ? 0 : state;
    const shift = view.kind === "prismatic" ? state : view.pitch * state, p = view.point || [0, 0, 0];
    const cos = Math.cos(turn), sin = Math.sin(turn), n = rest[0].length;
    const out = [new Float32Array(n), new Float32Array(n), new Float32Array(n)];
    for (let m = 0; m < n; m++) {
      const x = rest[0][m] - p[0], y = rest[1][m] - p[1], z = rest[2][m] - p[2], along = (a * x + b * y + c * z) * (1 - cos);
      out[0][m] = p[0] + x * cos + (b * z - c * y) * sin + a * (along + shift);
      out[1][m] = p[1] + y * cos + (c * x - a * z) * sin + b * (along + shift);
      out[2][m] = p[2] + z * cos + (a * y - b * x) * sin + c * (along + shift);
    }
    return out;
  }
  function bones(frame) {
    const points = [];
    if (hand && frame !== null && Number.isFinite(hand[63 * frame])) {
      for (const chain of view.bones) {
        for (const k of chain) points.push([0, 1, 2].map((d) => hand[63 * frame + 3 * k + d]));
        points.push([null, null, null]);
      }
    }
    return points.length ? points : [[null, null, null]];
  }
  const reach = view.low_corner.map((low, d) => [low, view.high_corner[d]]);
  for (const state of [view.low, view.high]) {
    pose(state).forEach((row, d) => row.forEach((v) => { reach[d] = [Math.min(reach[d][0], v), Math.max(reach[d][1], v)]; }));
  }
  const side = (d) => ({ visible: false, range: reach[d], autorange: false });
  const span = reach.map(([low, high]) => high - low), most = Math.max(...span);
  await Plotly.newPlot(place, [link(view.links.static, "static part"), moving, line(view.ends, "joint axis", "#e02a3a", 6),
                               line(bones(0), "hand", "#ffaa33", 7)], {
    margin: { l: 0, r: 0, t: 0, b: 0 }, showlegend: false, paper_bgcolor: "rgba(0,0,0,0)", uirevision: "kept",
    scene: { xaxis: side(0), yaxis: side(1), zaxis: side(2), aspectmode: "manual", dragmode: "orbit",
             aspectratio: { x: span[0] / most, y: span[1] / most, z: span[2] / most }, bgcolor: dark ? "#20252d" : "#eef1f5",
             camera: { eye: { x: view.eye[0], y: view.eye[1], z: view.eye[2] }, up: { x: 0, y: 0, z: 1 } } },
  }, { displaylogo: false, responsive: true, displayModeBar: false, scrollZoom: false });

  let shown = null;
  async function show(state, frame) {
    const number = (view.factor * state).toFixed(view.unit === "units" ? 3 : 0).replace(/^-(0[.0]*)$/, "$1");
    words.textContent = `${number} ${view.unit}`;
    if (shown === state) return;
    shown = state;
    const [x, y, z] = pose(state), points = bones(frame);
    await Plotly.restyle(place, { x: [x, points.map((p) => p[0])], y: [y, points.map((p) => p[1])],
                                  z: [z, points.map((p) => p[2])] }, [1, 3]);
  }
  slider.addEventListener("input", () => {
    follow.checked = false;
    show(view.low + (view.high - view.low) * slider.value / 1000, null);
  });
  let busy = false, last = 0;
  function step(now) {
    if (follow.checked && film && !busy && now - last > 60) {
      last = now;
      const at = film.currentTime;
      let frame = time.findIndex((t) => t > at);
      frame = Math.max(0, (frame < 0 ? time.length : frame) - 1);
      if (Number.isFinite(q[frame])) {
        busy = true;
        slider.value = 1000 * (q[frame] - view.low) / (view.high - view.low || 1);
        show(q[frame], frame).finally(() => { busy = false; });
      }
    }
    requestAnimationFrame(step);
  }
  requestAnimationFrame(step);
  place.dataset.ready = "yes";
}
