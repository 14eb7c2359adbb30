// Draws one atrium with WebGL: turned by mouse or arrow keys, coloured by a field, a region picked by name or by a click,
// deformed between end-diastole (0) and end-systole (1). Data: see shape.py. No library, no address outside this page.
"use strict";
function atrium(root, data) {
  const canvas = root.querySelector("canvas"), gl = canvas.getContext("webgl", { preserveDrawingBuffer: true, antialias: true });
  const told = root.querySelector(".told");
  if (!gl) { told.textContent = "This browser offers no WebGL: the 3D view cannot be drawn."; return null; }
  if (!gl.getExtension("OES_element_index_uint")) { told.textContent = "This browser's WebGL has no 32-bit indices."; return null; }
  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const floats = text => new Float32Array(bytes(text).buffer);
  const points = floats(data.points), displacement = floats(data.displacement), region = bytes(data.region);
  const triangles = new Uint32Array(bytes(data.triangles).buffer), count = points.length / 3;
  const fields = data.fields.map(f => ({ ...f, values: f.values ? floats(f.values) : null }));
  const vertexShader = `attribute vec3 p, u, n; attribute float v, r; uniform mat3 turn; uniform vec3 centre; uniform vec2 fit;
    uniform float load, low, high, flat_; uniform vec3 palette[8]; uniform float picked; varying vec3 colour, normal; varying float id;
    vec3 ramp(float t) { // viridis by a polynomial of degree 6 in t
      vec3 a = vec3(.2777, .0054, .3341), b = vec3(.1051, 1.4046, 1.3846), c = vec3(-.3309, .2148, .0951), d = vec3(-4.6342, -5.7991, -19.3324);
      vec3 e = vec3(6.2283, 14.1799, 56.6906), f = vec3(4.7764, -13.7451, -65.3530), g = vec3(-5.4355, 4.6459, 26.3124);
      return a + t * (b + t * (c + t * (d + t * (e + t * (f + t * g))))); }
    void main() { vec3 x = turn * (p + load * u - centre); gl_Position = vec4(x.x * fit.x, x.y * fit.y, -x.z * .004, 1.);
      normal = turn * n; id = r;
      if (flat_ > .5) { colour = palette[0]; for (int i = 1; i < 8; i++) if (abs(r - float(i)) < .5) colour = palette[i]; }
      else colour = v != v || v < -1e29 ? vec3(.75) : ramp(clamp((v - low) / max(high - low, 1e-30), 0., 1.));
      if (picked > .5 && abs(r - picked) > .5) colour = mix(colour, vec3(.93), .85); }`;
  const fragmentShader = `precision mediump float; varying vec3 colour, normal; varying float id; uniform float asId;
    void main() { float light = .35 + .65 * abs(normalize(normal).z);
      gl_FragColor = asId > .5 ? vec4(floor(id + .5) / 255., 0., 0., 1.) : vec4(colour * light, 1.); }`;
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertexShader], [gl.FRAGMENT_SHADER, fragmentShader]]) {
    const shader = gl.createShader(kind); gl.shaderSource(shader, text); gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  const uniform = name => gl.getUniformLocation(program, name);
  function attribute(name, values, size) {
    const at = gl.getAttribLocation(program, name); if (at < 0) return;
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer()); gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(at); gl.vertexAttribPointer(at, size, gl.FLOAT, false, 0, 0);
  }
  const normals = new Float32Array(3 * count), centre = [0, 0, 0]; let low = [1e30, 1e30, 1e30], high = [-1e30, -1e30, -1e30];
  for (let i = 0; i < count; i++) for (let k = 0; k < 3; k++) {
    low[k] = Math.min(low[k], points[3 * i + k]); high[k] = Math.max(high[k], points[3 * i + k]); }
  let radius = 0; for (let k = 0; k < 3; k++) { centre[k] = (low[k] + high[k]) / 2; radius += (high[k] - low[k]) ** 2 / 4; }
  radius = Math.sqrt(radius);
  for (let t = 0; t < triangles.length; t += 3) {
    const [a, b, c] = [triangles[t], triangles[t + 1], triangles[t + 2]].map(i => points.subarray(3 * i, 3 * i + 3));
    const e = [0, 1, 2].map(k => b[k] - a[k]), f = [0, 1, 2].map(k => c[k] - a[k]);
    const n = [e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0]];
    for (let j = 0; j < 3; j++) for (let k = 0; k < 3; k++) normals[3 * triangles[t + j] + k] += n[k];
  }
  attribute("p", points, 3); attribute("u", displacement, 3); attribute("n", normals, 3); attribute("r", Float32Array.from(region), 1);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer()); gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW);
  gl.enable(gl.DEPTH_TEST);
  gl.uniform3fv(uniform("centre"), centre); gl.uniform3fv(uniform("palette"), new Float32Array(data.palette.flat()));
  const state = { field: 0, region: 0, load: 0, zoom: 1, turn: data.view.slice() };
  function draw(asId) {
    const wide = canvas.width / canvas.height, scale = .95 * state.zoom / radius;
    gl.viewport(0, 0, canvas.width, canvas.height);
    if (asId) gl.clearColor(0, 0, 0, 1); else gl.clearColor(1, 1, 1, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix3fv(uniform("turn"), false, state.turn);
    gl.uniform2f(uniform("fit"), wide > 1 ? scale / wide : scale, wide > 1 ? scale : scale * wide);
    const f = fields[state.field];
    gl.uniform1f(uniform("load"), state.load); gl.uniform1f(uniform("flat_"), f.values ? 0 : 1);
    gl.uniform1f(uniform("low"), f.low || 0); gl.uniform1f(uniform("high"), f.high || 1);
    gl.uniform1f(uniform("picked"), state.region); gl.uniform1f(uniform("asId"), asId ? 1 : 0);
    gl.drawElements(gl.TRIANGLES, triangles.length, gl.UNSIGNED_INT, 0);
  }
  function say() {
    const f = fields[state.field], name = data.regions[state.region];
    root.querySelector(".low").textContent = f.values ? f.low.toPrecision(3) : "";
    root.querySelector(".high").textContent = f.values ? f.high.toPrecision(3) + " " + f.unit : "";
    root.querySelector(".bar").style.visibility = f.values ? "visible" : "hidden";
    told.textContent = state.region ? name + (f.means && f.means[name] != null ? ": " + f.means[name].toPrecision(3) + " " + f.unit + " (mean over the points drawn)" : "")
      : "Drag or arrow keys turn, the wheel zooms, a click picks a region.";
  }
  function choose(field) {
    state.field = field; shown.value = field;
    if (fields[field].values) attribute("v", fields[field].values, 1);
    show();
  }
  function show() { draw(false); say(); }
  function turned(dx, dy) { // about the screen's axes; the matrix is column-major
    const [cx, sx, cy, sy] = [Math.cos(dx), Math.sin(dx), Math.cos(dy), Math.sin(dy)], m = state.turn, r = new Array(9);
    for (let c = 0; c < 3; c++) {
      const [x, y, z] = [m[3 * c], m[3 * c + 1], m[3 * c + 2]], x1 = cx * x + sx * z, z1 = -sx * x + cx * z;
      r[3 * c] = x1; r[3 * c + 1] = cy * y - sy * z1; r[3 * c + 2] = sy * y + cy * z1;
    }
    state.turn = r; show();
  }
  function pick(region) { state.region = region; choices.value = region; show(); }
  const choices = root.querySelector("select.region"), shown = root.querySelector("select.field"), load = root.querySelector("input");
  choices.onchange = () => pick(+choices.value);
  shown.onchange = () => choose(+shown.value);
  load.oninput = () => { state.load = +load.value; show(); };
  let from = null, moved = 0;
  canvas.onpointerdown = e => { from = [e.clientX, e.clientY]; moved = 0; canvas.setPointerCapture(e.pointerId); };
  canvas.onpointermove = e => { if (!from) return; const d = [e.clientX - from[0], e.clientY - from[1]];
    moved += Math.abs(d[0]) + Math.abs(d[1]); from = [e.clientX, e.clientY]; turned(d[0] * .01, d[1] * .01); };
  canvas.onpointerup = e => { from = null; if (moved > 4) return;
    const box = canvas.getBoundingClientRect(), pixel = new Uint8Array(4); draw(true);
    gl.readPixels((e.clientX - box.left) * canvas.width / box.width, canvas.height - (e.clientY - box.top) * canvas.height / box.height,
      1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); pick(pixel[0] < data.regions.length ? pixel[0] : 0); };
  canvas.addEventListener("wheel", e => { e.preventDefault(); state.zoom *= Math.exp(-e.deltaY * .001); show(); }, { passive: false });
  canvas.onkeydown = e => { const step = { ArrowLeft: [-.1, 0], ArrowRight: [.1, 0], ArrowUp: [0, -.1], ArrowDown: [0, .1] }[e.key];
    if (step) { e.preventDefault(); turned(...step); } };
  choose(0);
  return { state, choose, pick, turned, pixels: () => { show(); const all = new Uint8Array(4 * canvas.width * canvas.height);
    gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, all); return all; } };
}
