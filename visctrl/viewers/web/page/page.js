// Asks for the run's state again and again, draws it, and passes STOP on until it is confirmed.
"use strict";
(() => {
  const PERIOD_MS = 100, RETRY_MS = 300, SILENT_MS = 1500, TRAIL = 14;
  const token = location.hash.slice(1);
  const headers = token ? { Authorization: `Bearer ${token}` } : {};
  const element = (id) => document.getElementById(id);
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const sleep = (ms) => new Promise((done) => setTimeout(done, ms));

  let about = null, state = null, image = null, shown = -1, heardAt = performance.now();
  let stopping = false, stopped = false;
  const path = { edition: 0, points: [] };
  const trails = new Map();

  async function ask(url, options = {}) {
    const answer = await fetch(url, { headers, signal: AbortSignal.timeout(3000), ...options });
    if (answer.status === 401) throw new Error("token");
    if (!answer.ok) throw new Error(String(answer.status));
    return answer;
  }

  function alarm(text) {
    element("alarm").hidden = !text;
    element("alarm").textContent = text;
  }

  // --- STOP -------------------------------------------------------------------------------------

  async function stop() {
    if (stopping || state?.end) return;
    stopping = true;
    showStatus();
    while (!stopped && !state?.end) {
      try {
        await ask("/stop", { method: "POST" });
        stopped = true;
        alarm("");
      } catch (error) {
        alarm(error.message === "token"
          ? "STOP was refused: open the page with the address that visctrl printed. Use the robot's own stop button."
          : "STOP IS NOT CONFIRMED: the program does not answer. Use the robot's own stop button.");
        await sleep(RETRY_MS);
      }
    }
    showStatus();
  }

  element("stop").addEventListener("pointerdown", stop);
  element("stop").addEventListener("click", stop);
  addEventListener("keydown", (event) => {
    if (event.key === " " || event.key === "Escape") {
      event.preventDefault();
      stop();
    }
  });

  // --- what is shown ----------------------------------------------------------------------------

  function showStatus() {
    const end = state?.end;
    const silent = !end && performance.now() - heardAt > SILENT_MS;
    let name = "driving", text = state?.message || "";
    if (end) [name, text] = [end.status, end.reason];
    else if (silent) [name, text] = ["silent", "no answer from the program: it has ended, or the network is down"];
    else if (stopped || state?.stopped) [name, text] = ["stopped", "the robot was told to stand still"];
    else if (stopping) [name, text] = ["stopping", ""];
    else if (!state) [name, text] = ["connecting", ""];
    else if (state.tick === undefined) name = "preparing";
    else if (!text) text = `${state.stage}${state.phase ? ": " + state.phase : ""}`;
    element("status").textContent = name === "silent" ? "no contact" : name;
    element("status").className = `status ${name}`;
    element("doing").textContent = text;
    const done = Boolean(end) || stopped || Boolean(state?.stopped);
    element("stop").classList.toggle("done", done);
    element("stop").firstChild.textContent = done ? "STOPPED" : "STOP";
    element("camera").style.opacity = silent ? 0.35 : 1;
    element("map").style.opacity = silent ? 0.35 : 1;
  }

  const fixed = (value, digits, unit) =>
    value === null || value === undefined ? "–" : `${value.toFixed(digits).replace("-", "−")} ${unit}`;

  function showNumbers() {
    const [v, omega] = state.sent, [x, y, phi] = state.pose;
    const degrees = phi === null ? null : (phi * 180) / Math.PI;
    const rows = [
      ["time", `${state.t.toFixed(1)} s`],
      ["v sent", fixed(v, 2, "m/s")],
      ["ω sent", fixed(omega, 1, "°/s")],
      [`x (${state.source})`, fixed(x, 2, "m")],
      [`y (${state.source})`, fixed(y, 2, "m")],
      [`φ (${state.source})`, fixed(degrees, 1, "°")],
      ["features", `${state.views.count}`, state.views.health !== "ok"],
      ["perception", state.views.reason || state.views.health, state.views.health !== "ok"],
      ["estimate", state.estimate.reason || state.estimate.health, state.estimate.health === "lost"],
      ["battery", fixed(state.battery, 1, "V")],
      ["missed ticks", `${state.missed}`, state.missed > 0],
    ];
    element("numbers").replaceChildren(...rows.map(([name, value, bad]) => {
      const row = document.createElement("div");
      row.className = bad ? "bad" : "";
      const dt = document.createElement("dt"), dd = document.createElement("dd");
      dt.textContent = name;
      dd.textContent = dd.title = value;
      row.append(dt, dd);
      return row;
    }));
    const parts = Object.entries(state.seconds);
    element("stages").replaceChildren(...parts.map(([name, ms]) => {
      const row = document.createElement("div"), label = document.createElement("span");
      const bar = document.createElement("b"), value = document.createElement("span");
      row.className = "stage";
      label.textContent = name;
      bar.style.width = `${Math.min(100, (100 * ms) / about.period_ms)}%`;
      value.textContent = `${ms.toFixed(1)} ms`;
      row.append(label, bar, value);
      return row;
    }));
    if (state.events.length) {
      element("events").replaceChildren(...state.events.toReversed().map(([t, text]) => {
        const item = document.createElement("li");
        item.textContent = `${t.toFixed(1)} s: ${text}`;
        return item;
      }));
    }
  }

  // --- pictures ---------------------------------------------------------------------------------

  function followFeatures() {
    const present = new Set(state.ids);
    for (const id of trails.keys()) if (!present.has(id)) trails.delete(id);
    state.ids.forEach((id, k) => {
      const trail = trails.get(id) ?? [];
      trail.push(state.pixels[k]);
      if (trail.length > TRAIL) trail.shift();
      trails.set(id, trail);
    });
  }

  function drawCamera() {
    const canvas = element("camera"), pen = canvas.getContext("2d");
    const [wide, high] = about.size;
    if (canvas.width !== wide) [canvas.width, canvas.height] = [wide, high];
    pen.clearRect(0, 0, wide, high);
    if (image) pen.drawImage(image, 0, 0, wide, high);
    const size = wide / 800;
    pen.lineWidth = 1.4 * size;
    pen.strokeStyle = "rgba(255,170,40,.85)";
    pen.beginPath();
    for (const trail of trails.values()) trail.forEach(([u, v], k) => (k ? pen.lineTo(u, v) : pen.moveTo(u, v)));
    pen.stroke();
    pen.strokeStyle = "rgb(90,230,110)";
    for (const trail of trails.values()) {
      const [u, v] = trail.at(-1);
      pen.beginPath();
      pen.arc(u, v, 3.2 * size, 0, 2 * Math.PI);
      pen.stroke();
    }
  }

  function drawMap() {
    const canvas = element("map"), box = canvas.getBoundingClientRect(), ratio = devicePixelRatio || 1;
    canvas.width = box.width * ratio;
    canvas.height = box.height * ratio;
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    const known = state.source === "true", pose = state.pose[0] === null ? null : state.pose;
    const all = path.points.concat(known ? [[0, 0, 0]] : [], pose ? [pose] : []);
    if (!all.length) return;
    const reach = about.outline.half + Math.max(about.outline.front, about.outline.rear);
    const xs = all.map((p) => p[0]), ys = all.map((p) => p[1]);
    const [left, right] = [Math.min(...xs) - reach, Math.max(...xs) + reach];
    const [bottom, top] = [Math.min(...ys) - reach, Math.max(...ys) + reach];
    const scale = Math.min(box.width / (right - left), box.height / (top - bottom)) * 0.94;
    const u = (x) => box.width / 2 + scale * (x - (left + right) / 2);
    const v = (y) => box.height / 2 - scale * (y - (bottom + top) / 2);
    grid(pen, box, u, v, scale);
    if (known) {
      robot(pen, u, v, scale, [0, 0, 0], colour("--bad"), true);
    }
    pen.strokeStyle = colour("--blue");
    pen.lineWidth = 2;
    pen.beginPath();
    path.points.concat(pose ? [pose] : []).forEach(([x, y], k) => (k ? pen.lineTo(u(x), v(y)) : pen.moveTo(u(x), v(y))));
    pen.stroke();
    if (pose) robot(pen, u, v, scale, pose, colour("--orange"), false);
  }

  function grid(pen, box, u, v, scale) {
    const step = [0.1, 0.25, 0.5, 1, 2, 5, 10].find((size) => size * scale > 45) ?? 25;
    const [x0, y0] = [-u(0) / scale, -(box.height - v(0)) / scale];
    pen.lineWidth = 1;
    pen.fillStyle = colour("--soft");
    pen.font = "11px system-ui, sans-serif";
    pen.strokeStyle = colour("--rule");
    pen.beginPath();
    for (let k = Math.ceil(x0 / step); u(k * step) < box.width; k++) {
      pen.moveTo(u(k * step), 0);
      pen.lineTo(u(k * step), box.height);
      pen.fillText(+(k * step).toFixed(2), u(k * step) + 3, box.height - 5);
    }
    for (let k = Math.ceil(y0 / step); v(k * step) > 0; k++) {
      pen.moveTo(0, v(k * step));
      pen.lineTo(box.width, v(k * step));
      pen.fillText(`${+(k * step).toFixed(2)} m`, 4, v(k * step) - 4);
    }
    pen.stroke();
  }

  function robot(pen, u, v, scale, [x, y, phi], stroke, dashed) {
    const { front, rear, half } = about.outline;
    pen.save();
    pen.translate(u(x), v(y));
    pen.rotate(-phi);
    pen.strokeStyle = pen.fillStyle = stroke;
    pen.lineWidth = 2;
    if (dashed) pen.setLineDash([5, 4]);
    pen.beginPath();
    pen.rect(-half * scale, -front * scale, 2 * half * scale, (front + rear) * scale);
    pen.moveTo(0, 0);
    pen.lineTo(0, -front * scale);
    pen.stroke();
    pen.globalAlpha = 0.15;
    if (!dashed) pen.fillRect(-half * scale, -front * scale, 2 * half * scale, (front + rear) * scale);
    pen.restore();
  }

  // --- asking -----------------------------------------------------------------------------------

  async function look() {
    about ??= await (await ask("/about")).json();
    element("title").textContent = document.title = about.title;
    const fresh = await (await ask(`/state?edition=${path.edition}&known=${path.points.length}`)).json();
    heardAt = performance.now();
    const added = fresh.path;
    path.points = path.points.slice(0, added.edition === path.edition ? added.from : 0).concat(added.points);
    path.edition = added.edition;
    const before = state?.tick;
    state = fresh;
    const ticked = state.tick !== undefined && state.tick !== before;
    if (ticked) {
      followFeatures();
      showNumbers();
      drawMap();
    }
    if (!image || (state.sequence !== undefined && state.sequence !== shown)) {
      const answer = await ask("/image");
      if (answer.status === 200) image = await createImageBitmap(await answer.blob());
      shown = state.sequence ?? -1;
    }
    if (ticked || state.tick === undefined) drawCamera();
  }

  async function watch() {
    while (!state?.end) {
      const began = performance.now();
      try {
        await look();
        if (!stopping || stopped) alarm("");
      } catch (error) {
        if (error.message === "token") alarm("The token is missing or wrong: open the page with the whole address that visctrl printed.");
      }
      showStatus();
      await sleep(Math.max(PERIOD_MS - (performance.now() - began), 20));
    }
  }

  addEventListener("resize", () => { if (state?.pose) drawMap(); });
  setInterval(showStatus, 500);
  watch();
})();
