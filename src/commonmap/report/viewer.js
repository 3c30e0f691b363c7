// A small point viewer in plain WebGL: orbit, pan, zoom; sets that can be shown and hidden; three
// ways to colour. Points come as 8 bytes each: int16 x, y, z, uint8 height, uint8 seen_by.
"use strict";
(function () {
  const canvas = document.getElementById("viewer");
  const message = document.getElementById("viewer-message");
  const meta = JSON.parse(document.getElementById("viewer-data").textContent);
  const gl = canvas.getContext("webgl", { antialias: true, alpha: false });
  if (!gl) {
    message.textContent = "This browser shows no 3D (WebGL is off); the pictures below hold the same maps.";
    message.hidden = false;
    return;
  }

  const vertexSource = `
    attribute vec3 place; attribute float height; attribute float seen;
    uniform mat4 view, projection; uniform vec3 halfExtent;
    uniform float pointSize, worldSize, mode; uniform vec3 setColour;
    varying vec3 colour;
    vec3 ramp(float t) {           // viridis, fitted by a polynomial
      vec3 c0 = vec3(0.2777, 0.0054, 0.3341), c1 = vec3(0.1051, 1.4046, 1.3846);
      vec3 c2 = vec3(-0.3309, 0.2148, 0.0951), c3 = vec3(-4.6342, -5.7991, -19.3324);
      vec3 c4 = vec3(6.2283, 14.1799, 56.6906), c5 = vec3(4.7764, -13.7451, -65.3530);
      vec3 c6 = vec3(-5.4355, 4.6459, 26.3124);
      return c0 + t*(c1 + t*(c2 + t*(c3 + t*(c4 + t*(c5 + t*c6)))));
    }
    void main() {
      vec4 p = view * vec4(place * halfExtent, 1.0);
      gl_Position = projection * p;
      gl_PointSize = clamp(pointSize * worldSize / max(-p.z, 1e-6), 1.2, 24.0);
      float shade = 0.72 + 0.28 * height;
      if (mode < 0.5) colour = setColour * shade;
      else if (mode < 1.5) colour = ramp(height);
      else {
        float s = floor(seen * 255.0 + 0.5);
        vec3 c = s < 1.5 ? vec3(0.23, 0.58, 0.87) : (s < 2.5 ? vec3(0.95, 0.60, 0.14) : vec3(0.20, 0.75, 0.53));
        colour = c * shade;
      }
    }`;
  const fragmentSource = `
    precision mediump float; varying vec3 colour;
    void main() {
      vec2 d = gl_PointCoord - 0.5;
      if (dot(d, d) > 0.25) discard;
      gl_FragColor = vec4(colour, 1.0);
    }`;

  function compile(kind, source) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    return shader;
  }
  const program = gl.createProgram();
  gl.attachShader(program, compile(gl.VERTEX_SHADER, vertexSource));
  gl.attachShader(program, compile(gl.FRAGMENT_SHADER, fragmentSource));
  gl.linkProgram(program);
  gl.useProgram(program);
  const at = {};
  for (const name of ["place", "height", "seen"]) at[name] = gl.getAttribLocation(program, name);
  const uniform = {};
  for (const name of ["view", "projection", "halfExtent", "pointSize", "worldSize", "mode", "setColour"])
    uniform[name] = gl.getUniformLocation(program, name);

  const sets = meta.sets.map(function (set) {
    const text = atob(set.points);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, bytes, gl.STATIC_DRAW);
    return { name: set.name, count: bytes.length / 8, buffer: buffer, colour: set.colour, shown: set.shown };
  });

  // The camera looks at `focus` from `distance`, turned by `yaw` (about z) and `pitch` (above ground)
  const radius = Math.max(Math.hypot(meta.half[0], meta.half[1], meta.half[2]), 1e-3);
  const home = { yaw: -0.9, pitch: 0.62, distance: 1.9 * radius, focus: [0, 0, -0.1 * meta.half[2]] };
  let camera, mode = 0, size = 1, asked = false;
  function reset() { camera = { yaw: home.yaw, pitch: home.pitch, distance: home.distance, focus: home.focus.slice() }; draw(); }

  function axes() {
    const cy = Math.cos(camera.yaw), sy = Math.sin(camera.yaw), cp = Math.cos(camera.pitch), sp = Math.sin(camera.pitch);
    return { right: [-sy, cy, 0], up: [-sp * cy, -sp * sy, cp], back: [cp * cy, cp * sy, sp] };
  }
  function viewMatrix() {
    const a = axes(), eye = camera.focus.map((f, i) => f + camera.distance * a.back[i]);
    const dot = (u) => -(u[0] * eye[0] + u[1] * eye[1] + u[2] * eye[2]);
    return new Float32Array([
      a.right[0], a.up[0], a.back[0], 0, a.right[1], a.up[1], a.back[1], 0,
      a.right[2], a.up[2], a.back[2], 0, dot(a.right), dot(a.up), dot(a.back), 1]);
  }
  function projectionMatrix(aspect) {
    const f = 1 / Math.tan(0.4), near = Math.max(camera.distance - 2 * radius - camera.distance * 0.2, camera.distance * 0.01);
    const far = camera.distance + 4 * radius + 1;
    return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, 2 * far * near / (near - far), 0]);
  }

  function hexColour(name) {
    const text = getComputedStyle(document.documentElement).getPropertyValue(name).trim();
    return [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16) / 255);
  }
  function paint() {
    asked = false;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    gl.viewport(0, 0, width, height);
    const back = hexColour("--viewer");
    gl.clearColor(back[0], back[1], back[2], 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.uniformMatrix4fv(uniform.view, false, viewMatrix());
    gl.uniformMatrix4fv(uniform.projection, false, projectionMatrix(width / height));
    gl.uniform3fv(uniform.halfExtent, meta.half);
    gl.uniform1f(uniform.pointSize, size);
    gl.uniform1f(uniform.mode, mode);
    for (const set of sets) {
      if (!set.shown || !set.count) continue;
      // A point is drawn about as wide as the mean distance between points of its set
      const spacing = Math.sqrt(4 * meta.half[0] * meta.half[1] / set.count) * 0.9;
      gl.uniform1f(uniform.worldSize, spacing * height / (2 * Math.tan(0.4)));
      gl.uniform3fv(uniform.setColour, set.colour);
      gl.bindBuffer(gl.ARRAY_BUFFER, set.buffer);
      gl.enableVertexAttribArray(at.place);
      gl.vertexAttribPointer(at.place, 3, gl.SHORT, true, 8, 0);
      if (at.height >= 0) { gl.enableVertexAttribArray(at.height); gl.vertexAttribPointer(at.height, 1, gl.UNSIGNED_BYTE, true, 8, 6); }
      if (at.seen >= 0) { gl.enableVertexAttribArray(at.seen); gl.vertexAttribPointer(at.seen, 1, gl.UNSIGNED_BYTE, true, 8, 7); }
      gl.drawArrays(gl.POINTS, 0, set.count);
    }
    canvas.dataset.painted = String(gl.getError());   // 0: no error
  }
  function draw() { if (!asked) { asked = true; requestAnimationFrame(paint); } }

  function orbit(dx, dy) {
    camera.yaw -= dx * 0.006;
    camera.pitch = Math.min(1.57, Math.max(-0.3, camera.pitch + dy * 0.006));
    draw();
  }
  function pan(dx, dy) {
    const a = axes(), step = camera.distance * 0.85 / Math.max(canvas.clientHeight, 1);
    for (let i = 0; i < 3; i++) camera.focus[i] += step * (-dx * a.right[i] + dy * a.up[i]);
    draw();
  }
  function zoom(factor) {
    camera.distance = Math.min(8 * radius, Math.max(0.02 * radius, camera.distance * factor));
    draw();
  }

  const fingers = new Map();
  let pinch = 0;
  canvas.addEventListener("pointerdown", function (event) {
    canvas.setPointerCapture(event.pointerId);
    canvas.focus({ preventScroll: true });
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    pinch = 0;
  });
  canvas.addEventListener("pointermove", function (event) {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const dx = event.clientX - last[0], dy = event.clientY - last[1];
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (fingers.size === 2) {
      const [p, q] = Array.from(fingers.values()), gap = Math.hypot(p[0] - q[0], p[1] - q[1]);
      if (pinch > 0 && gap > 0) zoom(pinch / gap);
      pinch = gap;
      pan(dx / 2, dy / 2);
    } else if (event.buttons & 2 || event.shiftKey) pan(dx, dy);
    else orbit(dx, dy);
  });
  for (const kind of ["pointerup", "pointercancel"])
    canvas.addEventListener(kind, function (event) { fingers.delete(event.pointerId); pinch = 0; });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", function (event) {
    if (document.activeElement !== canvas) return;   // the page scrolls until the picture is clicked
    event.preventDefault();
    zoom(Math.exp(Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 120) * 0.0015));
  }, { passive: false });
  canvas.addEventListener("keydown", function (event) {
    const move = event.shiftKey ? pan : orbit;
    if (event.key === "ArrowLeft") move(20, 0);
    else if (event.key === "ArrowRight") move(-20, 0);
    else if (event.key === "ArrowUp") move(0, 20);
    else if (event.key === "ArrowDown") move(0, -20);
    else if (event.key === "+" || event.key === "=") zoom(0.85);
    else if (event.key === "-") zoom(1 / 0.85);
    else if (event.key === "r") reset();
    else return;
    event.preventDefault();
  });

  document.querySelectorAll("[data-set]").forEach(function (box) {
    box.addEventListener("change", function () {
      const set = sets.find((s) => s.name === box.dataset.set);
      if (set) set.shown = box.checked;
      draw();
    });
    const set = sets.find((s) => s.name === box.dataset.set);
    if (set) set.shown = box.checked;       // a reloaded page may keep the state of its boxes
  });
  document.querySelectorAll("[name=colour]").forEach(function (radio) {
    radio.addEventListener("change", function () { if (radio.checked) mode = Number(radio.value); draw(); });
    if (radio.checked) mode = Number(radio.value);
  });
  const slider = document.getElementById("viewer-size");
  slider.addEventListener("input", function () { size = Math.pow(2, Number(slider.value)); draw(); });
  size = Math.pow(2, Number(slider.value));
  document.getElementById("viewer-reset").addEventListener("click", reset);
  document.getElementById("viewer-top").addEventListener("click", function () { reset(); camera.yaw = -Math.PI / 2; camera.pitch = 1.57; draw(); });
  window.addEventListener("resize", draw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  canvas.addEventListener("webglcontextlost", function (event) {
    event.preventDefault();
    message.textContent = "The 3D picture was lost by the browser; reload the page to see it again.";
    message.hidden = false;
  });
  reset();
})();
