"use strict";
// Draws the scene of this page with WebGL 2: turntable camera, time slider, names of bodies. z is up, lengths are in m.
(async () => {
  const $ = (id) => document.getElementById(id), canvas = $("view");
  const scene = JSON.parse($("scene").textContent);
  const gl = canvas.getContext("webgl2", { antialias: true, stencil: true, alpha: false });
  if (!gl) { $("tip").textContent = "This page needs WebGL 2."; $("tip").style.opacity = 1; return; }
  const packed = Uint8Array.from(atob(scene.data), (c) => c.charCodeAt(0));
  const unpacked = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const data = await new Response(unpacked).arrayBuffer();

  // Programs
  const program = (vertex, fragment) => {
    const p = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const s = gl.createShader(kind);
      gl.shaderSource(s, "#version 300 es\nprecision highp float;\n" + text);
      gl.compileShader(s);
      if (!gl.getShaderParameter(s, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(s));
      gl.attachShader(p, s);
    }
    gl.linkProgram(p);
    const uniforms = {}, count = gl.getProgramParameter(p, gl.ACTIVE_UNIFORMS);
    for (let i = 0; i < count; i++) {
      const name = gl.getActiveUniform(p, i).name;
      uniforms[name] = gl.getUniformLocation(p, name);
    }
    return { p, uniforms };
  };
  const body = program(
    `layout(location=0) in vec3 a; layout(location=1) in vec3 b; uniform mat4 V, M; out vec3 x, n;
     void main() { vec4 w = M * vec4(a, 1.); x = w.xyz; n = mat3(M) * b; gl_Position = V * w; }`,
    `in vec3 x, n; uniform vec4 color; uniform vec3 eye; uniform float plain; out vec4 o;
     void main() {
       if (plain > 0.) { o = color; return; }
       vec3 N = normalize(n), E = normalize(eye - x);
       if (dot(N, E) < 0.) N = -N;
       vec3 K = normalize(vec3(.35, -.45, .82)), F = normalize(vec3(-.7, .5, .25));
       vec3 sky = mix(vec3(.36, .34, .33), vec3(.60, .63, .68), .5 + .5 * N.z);
       vec3 base = pow(color.rgb, vec3(2.2));
       vec3 light = sky * sky * .95 + vec3(1.02, 1., .95) * .60 * max(dot(N, K), 0.) + vec3(.16) * max(dot(N, F), 0.);
       float shine = pow(max(dot(N, normalize(K + E)), 0.), 40.) * .22 + pow(1. - max(dot(N, E), 0.), 4.) * .06;
       o = vec4(pow(base * light + shine, vec3(1. / 2.2)), color.a);
     }`);
  const floor = program(
    `layout(location=0) in vec3 a; uniform mat4 V; uniform vec3 at; uniform float size; out vec2 x;
     void main() { vec3 w = at + size * a; x = w.xy; gl_Position = V * vec4(w, 1.); }`,
    `in vec2 x; uniform vec3 at; uniform float size, step; out vec4 o;
     float lines(float s, float w) { vec2 u = x / s, d = fwidth(u), f = abs(fract(u - .5) - .5) / d;
       return clamp(w - min(f.x, f.y), 0., 1.) * clamp(.35 / max(d.x, d.y), 0., 1.); }
     void main() {
       float fade = 1. - smoothstep(.25, 1., length(x - at.xy) / size), d = max(lines(step, 1.), 1.6 * lines(5. * step, 1.5));
       o = vec4(mix(vec3(.96, .97, .98), vec3(.52, .57, .63), .45 * d), fade * (.5 + .25 * d));
     }`);

  // Geometries: corners with smooth normals, except across edges of more than 37 degrees
  const corners = (P, T) => {
    const n = T.length, unit = new Float32Array(n), area = new Float32Array(n / 3), out = new Float32Array(2 * n * 3);
    for (let f = 0; f < n; f += 3) {
      const [a, b, c] = [3 * T[f], 3 * T[f + 1], 3 * T[f + 2]];
      const u = [0, 1, 2].map((k) => P[b + k] - P[a + k]), v = [0, 1, 2].map((k) => P[c + k] - P[a + k]);
      const w = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]], l = Math.hypot(...w);
      area[f / 3] = l;
      for (let k = 0; k < 3; k++) unit[f + k] = l ? w[k] / l : 0;
    }
    const start = new Uint32Array(P.length / 3 + 1), around = new Uint32Array(n);
    for (let c = 0; c < n; c++) start[T[c] + 1]++;
    for (let k = 1; k < start.length; k++) start[k] += start[k - 1];
    const next = start.slice();
    for (let c = 0; c < n; c++) around[next[T[c]]++] = (c / 3) | 0;
    for (let c = 0; c < n; c++) {
      const v = T[c], f = 3 * ((c / 3) | 0);
      let x = 0, y = 0, z = 0;
      for (let k = start[v]; k < start[v + 1]; k++) {
        const g = 3 * around[k], w = area[around[k]];
        if (unit[f] * unit[g] + unit[f + 1] * unit[g + 1] + unit[f + 2] * unit[g + 2] < .8) continue;
        x += w * unit[g]; y += w * unit[g + 1]; z += w * unit[g + 2];
      }
      out.set([P[3 * v], P[3 * v + 1], P[3 * v + 2], x, y, z], 6 * c);
    }
    return out;
  };
  const array = (values, stride) => {
    const vao = gl.createVertexArray();
    gl.bindVertexArray(vao);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    for (let k = 0; k < stride / 3; k++) {
      gl.enableVertexAttribArray(k);
      gl.vertexAttribPointer(k, 3, gl.FLOAT, false, 4 * stride, 12 * k);
    }
    return { vao, count: values.length / stride };
  };
  const geometries = scene.geometries.map((g) => {
    const grid = new Uint16Array(data, g.vertices[0], 3 * g.vertices[1]), P = new Float32Array(grid.length);
    for (let i = 0; i < P.length; i++) P[i] = g.low[i % 3] + g.step[i % 3] * grid[i];
    const T = new Int32Array(data, g.triangles[0], 3 * g.triangles[1]).slice();
    for (let i = 1; i < T.length; i++) T[i] += T[i - 1];
    return array(corners(P, T), 6);
  });
  const plane = array(new Float32Array([-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, -1, 0, 1, 1, 0, -1, 1, 0]), 3);

  // Matrices by columns, as WebGL has them
  const mul = (A, B) => {
    const C = new Float32Array(16);
    for (let j = 0; j < 4; j++) for (let i = 0; i < 4; i++) for (let k = 0; k < 4; k++) C[4 * j + i] += A[4 * k + i] * B[4 * j + k];
    return C;
  };
  const placed = (p, q) => {
    const l = Math.hypot(...q) || 1, [x, y, z, w] = q.map((c) => c / l);
    return new Float32Array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), 0,
      2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), 0,
      2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), 0, ...p, 1]);
  };
  const shapes = scene.shapes.map((s) => ({ ...s, local: placed(s.pose.slice(0, 3), s.pose.slice(3)), M: null }));
  shapes.sort((a, b) => b.color[3] - a.color[3]);
  const count = scene.bodies.length, t = scene.t, last = t.length - 1, poses = new Float32Array(data, scene.poses);
  const pose = (time) => {
    let k = 0;
    for (let low = 0, high = last; low <= high;) { const m = (low + high) >> 1; if (t[m] <= time) { k = m; low = m + 1; } else high = m - 1; }
    const next = Math.min(k + 1, last), part = next > k ? (time - t[k]) / (t[next] - t[k]) : 0;
    const bodies = scene.bodies.map((_, b) => {
      const A = poses.subarray(7 * (k * count + b), 7 * (k * count + b) + 7), B = poses.subarray(7 * (next * count + b), 7 * (next * count + b) + 7);
      const sign = A[3] * B[3] + A[4] * B[4] + A[5] * B[5] + A[6] * B[6] < 0 ? -1 : 1;
      const mix = (i, s) => A[i] + part * (s * B[i] - A[i]);
      return placed([mix(0, 1), mix(1, 1), mix(2, 1)], [mix(3, sign), mix(4, sign), mix(5, sign), mix(6, sign)]);
    });
    for (const s of shapes) s.M = mul(bodies[s.body], s.local);
  };

  // Camera
  const home = scene.camera, cam = { ...home, target: [...home.target] };
  const basis = () => {
    const [ca, sa, ce, se] = [Math.cos(cam.azimuth), Math.sin(cam.azimuth), Math.cos(cam.elevation), Math.sin(cam.elevation)];
    const back = [ca * ce, sa * ce, se];
    return { right: [-sa, ca, 0], up: [-ca * se, -sa * se, ce], back, eye: cam.target.map((x, i) => x + cam.distance * back[i]) };
  };
  const view = (aspect) => {
    const { right: r, up: u, back: b, eye: e } = basis(), dot = (x) => -(x[0] * e[0] + x[1] * e[1] + x[2] * e[2]);
    const f = 1 / Math.tan(17.5 * Math.PI / 180) * Math.min(1, aspect), near = .02 * cam.distance, far = cam.distance + 40 * home.reach;
    const V = new Float32Array([r[0], u[0], b[0], 0, r[1], u[1], b[1], 0, r[2], u[2], b[2], 0, dot(r), dot(u), dot(b), 1]);
    return mul(new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0]), V);
  };

  // One frame
  const light = [.35, -.45, .82], round = 10 ** Math.floor(Math.log10(home.reach / 2)), ratio = home.reach / 2 / round;
  const step = round * (ratio < 2 ? .5 : ratio < 5 ? 1 : 2);
  const draw = (V, each) => {
    gl.useProgram(body.p);
    gl.uniformMatrix4fv(body.uniforms.V, false, V);
    gl.uniform3fv(body.uniforms.eye, basis().eye);
    shapes.forEach((s, i) => {
      const { M, color, plain } = each(s, i);
      if (!color) return;
      gl.uniformMatrix4fv(body.uniforms.M, false, M);
      gl.uniform4fv(body.uniforms.color, color);
      gl.uniform1f(body.uniforms.plain, plain);
      gl.bindVertexArray(geometries[s.geometry].vao);
      gl.drawArrays(gl.TRIANGLES, 0, geometries[s.geometry].count);
    });
  };
  let hovered = -1;
  const render = () => {
    const ratio = Math.min(devicePixelRatio || 1, 2), w = Math.round(canvas.clientWidth * ratio), h = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    gl.viewport(0, 0, w, h);
    gl.clearColor(.90, .92, .945, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.disable(gl.DEPTH_TEST);
    const V = view(w / h), z = scene.ground - 1e-3 * home.reach;
    gl.useProgram(floor.p);
    gl.uniformMatrix4fv(floor.uniforms.V, false, V);
    gl.uniform3f(floor.uniforms.at, home.target[0], home.target[1], z);
    gl.uniform1f(floor.uniforms.size, 8 * home.reach);
    gl.uniform1f(floor.uniforms.step, step);
    gl.bindVertexArray(plane.vao);
    gl.drawArrays(gl.TRIANGLES, 0, plane.count);
    if (basis().eye[2] > z) {
      // Every point of a shadow is darkened once.
      const S = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, -light[0] / light[2], -light[1] / light[2], 0, 0, z * light[0] / light[2], z * light[1] / light[2], z, 1]);
      gl.enable(gl.STENCIL_TEST);
      gl.stencilFunc(gl.EQUAL, 0, 255);
      gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
      draw(V, (s) => ({ M: mul(S, s.M), color: [.12, .15, .2, .16 * s.color[3]], plain: 1 }));
      gl.disable(gl.STENCIL_TEST);
    }
    gl.enable(gl.DEPTH_TEST);
    draw(V, (s) => ({ M: s.M, color: s.color[3] === 1 && s.body === hovered ? s.color.map((c) => Math.min(1, c * .85 + .15)) : s.color, plain: 0 }));
  };

  // The body under the pointer: one pixel, in which a colour is a number
  const pixel = gl.createFramebuffer(), target = gl.createRenderbuffer(), depth = gl.createRenderbuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, pixel);
  for (const [buffer, format, point] of [[target, gl.RGBA8, gl.COLOR_ATTACHMENT0], [depth, gl.DEPTH_COMPONENT16, gl.DEPTH_ATTACHMENT]]) {
    gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
    gl.renderbufferStorage(gl.RENDERBUFFER, format, 1, 1);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, point, gl.RENDERBUFFER, buffer);
  }
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  const pick = (x, y) => {
    const w = canvas.clientWidth, h = canvas.clientHeight, cx = 2 * x / w - 1, cy = 1 - 2 * y / h, out = new Uint8Array(4);
    gl.bindFramebuffer(gl.FRAMEBUFFER, pixel);
    gl.viewport(0, 0, 1, 1);
    gl.disable(gl.BLEND);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const zoom = new Float32Array([w, 0, 0, 0, 0, h, 0, 0, 0, 0, 1, 0, -cx * w, -cy * h, 0, 1]);
    draw(mul(zoom, view(w / h)), (s) => ({ M: s.M, color: [((s.body + 1) & 255) / 255, ((s.body + 1) >> 8) / 255, 0, 1], plain: 1 }));
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, out);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return out[0] + 256 * out[1] - 1;
  };

  // Controls
  let time = t[0], playing = last > 0, speed = 1, before = 0, dirty = true, pointer = null;
  const slider = $("time"), down = new Map();
  const go = (to) => { time = Math.min(Math.max(to, t[0]), t[last]); pose(time); dirty = true; slider.value = time; $("clock").textContent = time.toFixed(2) + " s"; };
  const play = (on) => { playing = on && last > 0; $("play").textContent = playing ? "❚❚" : "▶"; };
  if (!last) $("controls").style.display = "none";
  Object.assign(slider, { min: t[0], max: t[last], step: "any" });
  slider.oninput = () => { play(false); go(+slider.value); };
  $("play").onclick = () => play(!playing);
  $("speed").onchange = () => { speed = +$("speed").value; };
  const pan = (dx, dy) => {
    const { right, up } = basis(), k = cam.distance * Math.tan(17.5 * Math.PI / 180) * 2 / canvas.clientHeight;
    cam.target = cam.target.map((x, i) => x - k * (dx * right[i] - dy * up[i]));
  };
  const zoomBy = (k) => { cam.distance = Math.min(Math.max(cam.distance * k, .05 * home.reach), 40 * home.reach); dirty = true; };
  canvas.onpointerdown = (e) => { canvas.setPointerCapture(e.pointerId); down.set(e.pointerId, e); };
  canvas.onpointerup = canvas.onpointercancel = (e) => down.delete(e.pointerId);
  canvas.onpointermove = (e) => {
    const from = down.get(e.pointerId);
    pointer = from ? null : e;
    if (!from) return;
    const dx = e.clientX - from.clientX, dy = e.clientY - from.clientY;
    if (down.size === 2) {
      const other = [...down.values()].find((o) => o.pointerId !== e.pointerId), far = (o) => Math.hypot(o.clientX - other.clientX, o.clientY - other.clientY);
      zoomBy(far(from) / Math.max(far(e), 1));
      pan(dx / 2, dy / 2);
    } else if (e.shiftKey || e.buttons & 6) pan(dx, dy);
    else {
      cam.azimuth -= dx * .008;
      cam.elevation = Math.min(Math.max(cam.elevation + dy * .008, -1.57), 1.57);
    }
    down.set(e.pointerId, e);
    dirty = true;
  };
  canvas.onpointerleave = () => { pointer = null; $("tip").style.opacity = 0; };
  canvas.onwheel = (e) => { e.preventDefault(); zoomBy(Math.exp(Math.sign(e.deltaY) * .1)); };
  canvas.oncontextmenu = (e) => e.preventDefault();
  canvas.ondblclick = () => { Object.assign(cam, home, { target: [...home.target] }); dirty = true; };
  window.onresize = () => { dirty = true; };
  window.onkeydown = (e) => {
    if (e.key === " ") { play(!playing); e.preventDefault(); }
    if (e.key === "ArrowRight" || e.key === "ArrowLeft") { play(false); go(time + (e.key === "ArrowRight" ? 1 : -1) * (t[last] - t[0]) / Math.max(last, 1)); }
  };
  const loop = (now) => {
    const passed = Math.min((now - before) / 1000, .1);
    before = now;
    if (playing) go(time >= t[last] ? t[0] : time + speed * passed);
    if (pointer && (playing || pointer.isNew !== false)) {
      const found = pick(pointer.offsetX, pointer.offsetY), tip = $("tip");
      if (found !== hovered) { hovered = found; dirty = true; }
      tip.textContent = found >= 0 ? scene.bodies[found] : "";
      tip.style.opacity = found >= 0 ? 1 : 0;
      tip.style.transform = `translate(${pointer.offsetX + 14}px, ${pointer.offsetY + 10}px)`;
      pointer.isNew = false;
    }
    if (dirty) { dirty = false; render(); }
    requestAnimationFrame(loop);
  };
  play(true);
  // An address may end in a time at which the motion stands, such as #t=0.5.
  const start = /^#t=([\d.]+)$/.exec(location.hash);
  go(start ? +start[1] : t[0]);
  if (start) play(false);
  requestAnimationFrame(loop);
})();
