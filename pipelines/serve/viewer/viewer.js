/* The panorama as a picture that zooms deep: tiles on a canvas, the chosen point, the outlines of frames that see it.
   Panorama coordinates are px of the finest level, (0, 0) the centre of its first pixel, as in panorama.json. */
(function () {
  "use strict";
  const $ = (id) => document.getElementById(id);
  const canvas = $("view"), pen = canvas.getContext("2d");
  const MAX_ZOOM = 8, KEPT = 300; // screen px per panorama px; tiles
  let run, shot, picture;              // the run, the shot shown, its panorama
  let zoom = 1, left = 0, top = 0;     // screen px per panorama px; panorama coordinates of the canvas's top left corner
  let point = null, frames = [], frame = null; // the answer about the point; the frames that see it; the frame shown
  let asked = 0;
  const tiles = new Map();

  const number = (value, digits) => value.toFixed(digits).replace("-", "−");
  const get = (path) => fetch(path).then((reply) => (reply.ok ? reply.json() : Promise.reject(new Error(path + ": " + reply.status))));
  const width = () => canvas.clientWidth, height = () => canvas.clientHeight;
  const toScreen = ([x, y]) => [(x - left) * zoom, (y - top) * zoom];
  const toPanorama = (sx, sy) => [left + sx / zoom, top + sy / zoom];
  const fitZoom = () => Math.min(width() / picture.levels[0][0], height() / picture.levels[0][1]);

  // ---- drawing
  function tile(level, column, row) {
    const key = [shot, level, column, row].join("/");
    let found = tiles.get(key);
    if (found) { tiles.delete(key); tiles.set(key, found); return found; } // the one used last is dropped last
    found = new Image();
    found.onload = draw;
    found.src = "tile/" + key;
    tiles.set(key, found);
    if (tiles.size > KEPT) tiles.delete(tiles.keys().next().value);
    return found;
  }

  function drawLevel(level) {
    const [w, h] = picture.levels[level], size = picture.tile_px;
    const scale = picture.levels[0][0] / w; // panorama px per px of the level
    const across = Math.ceil(w / size), down = Math.ceil(h / size), step = size * scale;
    const c0 = Math.max(0, Math.floor((left + .5) / step)), c1 = Math.min(across - 1, Math.floor((left + .5 + width() / zoom) / step));
    const r0 = Math.max(0, Math.floor((top + .5) / step)), r1 = Math.min(down - 1, Math.floor((top + .5 + height() / zoom) / step));
    let missing = 0;
    for (let row = r0; row <= r1; row++) for (let column = c0; column <= c1; column++) {
      const image = tile(level, column, row);
      if (!image.complete || !image.naturalWidth) { missing++; continue; }
      const [x, y] = toScreen([column * step - .5, row * step - .5]);
      // A hair wider than the tile, against seams between tiles.
      pen.drawImage(image, x, y, image.naturalWidth * scale * zoom + .6, image.naturalHeight * scale * zoom + .6);
    }
    return missing;
  }

  function outline(points, colour, thick) {
    pen.beginPath();
    points.forEach((p, k) => { const [x, y] = toScreen(p); if (k) pen.lineTo(x, y); else pen.moveTo(x, y); });
    pen.closePath();
    pen.lineWidth = thick + 2; pen.strokeStyle = "rgba(0,0,0,.6)"; pen.stroke();
    pen.lineWidth = thick; pen.strokeStyle = colour; pen.stroke();
  }

  let waiting = false;
  function draw() { if (!waiting) { waiting = true; requestAnimationFrame(() => { waiting = false; paint(); }); } }
  function paint() {
    if (!picture) return;
    const ratio = window.devicePixelRatio || 1;
    const w = Math.round(width() * ratio), h = Math.round(height() * ratio);
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.fillStyle = "#181818"; pen.fillRect(0, 0, width(), height());
    const last = picture.levels.length - 1;
    const level = Math.max(0, Math.min(last, Math.floor(Math.log2(1 / (zoom * ratio)) + .3)));
    let missing = 0;
    if (level !== last) drawLevel(last); // something is there while the fine tiles come
    missing = drawLevel(level);
    if (frame && frame.outline) outline(frame.outline, "#ffd24a", 2);
    if (point) {
      const [x, y] = toScreen(point.pixel);
      for (const [colour, thick] of [["rgba(0,0,0,.7)", 5], ["#ff4d6d", 2.5]]) {
        pen.strokeStyle = colour; pen.lineWidth = thick;
        pen.beginPath(); pen.moveTo(x - 11, y); pen.lineTo(x + 11, y); pen.moveTo(x, y - 11); pen.lineTo(x, y + 11); pen.stroke();
      }
    }
    Object.assign(document.documentElement.dataset, { level, missing, zoom: zoom.toFixed(5), left: left.toFixed(2), top: top.toFixed(2) });
  }

  // ---- moving
  function bounded() {
    zoom = Math.max(fitZoom() * .8, Math.min(MAX_ZOOM, zoom));
    const [w, h] = picture.levels[0], sw = width() / zoom, sh = height() / zoom;
    left = sw >= w ? (w - sw) / 2 - .5 : Math.max(-.5, Math.min(w - .5 - sw, left));
    top = sh >= h ? (h - sh) / 2 - .5 : Math.max(-.5, Math.min(h - .5 - sh, top));
    draw();
  }
  function zoomAt(factor, sx, sy) {
    const [x, y] = toPanorama(sx, sy), before = zoom;
    zoom = Math.max(fitZoom() * .8, Math.min(MAX_ZOOM, zoom * factor));
    if (zoom === before) return;
    left = x - sx / zoom; top = y - sy / zoom; bounded();
  }
  function fit() { zoom = fitZoom(); bounded(); }
  function show([x, y]) { // into view, where it is not
    const [sx, sy] = toScreen([x, y]);
    if (sx < 0 || sy < 0 || sx > width() || sy > height()) { left = x - width() / zoom / 2; top = y - height() / zoom / 2; bounded(); }
  }

  // ---- the point and its frames
  function ask(x, y) {
    const [w, h] = picture.levels[0];
    if (x < -.5 || y < -.5 || x > w - .5 || y > h - .5) return Promise.resolve();
    const ticket = ++asked;
    return get("api/point/" + shot + "?x=" + x.toFixed(3) + "&y=" + y.toFixed(3)).then((answer) => {
      if (ticket !== asked) return undefined; // a later click has overtaken this one
      point = answer; frames = [];
      for (const [a, b] of answer.frames) for (let k = a; k <= b; k++) frames.push(k);
      $("hint").hidden = true; $("facts").hidden = false;
      $("angles").textContent = answer.ray ? number(answer.pan_deg, 3) + "°, " + number(answer.tilt_deg, 3) + "°" : answer.why_none;
      $("ray").textContent = answer.ray ? answer.ray.map((v) => number(v, 6)).join(", ") : "not known";
      $("pixel").textContent = answer.pixel.map((v) => number(v, 1)).join(", ");
      $("seen").textContent = answer.n_frames === 0 ? "no frame" : answer.n_frames === 1 ? "1 frame" : answer.n_frames + " frames";
      $("frames").replaceChildren(...answer.frames.slice(0, 60).map(([a, b]) => {
        const item = document.createElement("li"), button = document.createElement("button");
        button.textContent = a === b ? String(a) : a + "–" + b;
        button.dataset.first = a; button.dataset.last = b;
        button.addEventListener("click", () => choose(answer.best.frame >= a && answer.best.frame <= b ? answer.best.frame : Math.round((a + b) / 2)));
        item.append(button);
        return item;
      }));
      $("one").hidden = !frames.length; $("slider").max = Math.max(0, frames.length - 1);
      draw();
      document.documentElement.dataset.point = ticket;
      if (frames.length) return choose(answer.best.frame);
      frame = null;
      return undefined;
    });
  }
  function choose(which) {
    const place = frames.indexOf(which);
    if (place < 0) return Promise.resolve();
    const ticket = ++asked;
    return get("api/frame/" + shot + "/" + which + "?x=" + point.pixel[0] + "&y=" + point.pixel[1]).then((answer) => {
      if (ticket !== asked) return;
      frame = answer;
      $("slider").value = place;
      $("slider").setAttribute("aria-valuetext", "frame " + which);
      $("frame-name").textContent = "Frame " + which;
      const parts = [answer.sign + " " + answer.status];
      if (answer.pts_s !== null) parts.push(number(answer.pts_s, 3) + " s");
      if (answer.timecode) parts.push(answer.timecode);
      if (answer.pixel) parts.push("there at pixel " + answer.pixel.map((v) => number(v, 1)).join(", "));
      $("frame-facts").textContent = parts.join(", ");
      $("open").href = "report#frame=" + which; $("open").parentElement.hidden = !run.report;
      const has = answer.thumbnail !== null;
      $("thumb").hidden = !has;
      if (has) { $("thumb").src = "thumbnail/" + answer.thumbnail; $("thumb").alt = "Frame " + answer.thumbnail; }
      $("thumb-name").textContent = !has ? "No thumbnail." : answer.thumbnail === which ? "" : "Nearest picture: frame " + answer.thumbnail;
      document.querySelectorAll("#frames button").forEach((b) => b.setAttribute("aria-current", which >= +b.dataset.first && which <= +b.dataset.last));
      document.documentElement.dataset.frame = which;
      draw();
    });
  }
  const step = (by) => { if (frame) choose(frames[Math.max(0, Math.min(frames.length - 1, frames.indexOf(frame.frame) + by))]); };
  function nothing() {
    asked++; point = null; frame = null; frames = [];
    $("facts").hidden = true; $("hint").hidden = false; $("one").hidden = true; $("frames").replaceChildren();
    delete document.documentElement.dataset.frame; delete document.documentElement.dataset.point;
    draw();
  }

  // ---- mouse, fingers, keys
  const fingers = new Map();
  let moved = 0, pinch = 0;
  const at = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, at(event));
    if (fingers.size === 1) moved = 0;
    pinch = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const here = at(event);
    if (picture) { const p = toPanorama(...here); $("where").textContent = "x " + number(p[0], 1) + ", y " + number(p[1], 1) + " px"; }
    if (!fingers.has(event.pointerId)) return;
    const before = fingers.get(event.pointerId);
    fingers.set(event.pointerId, here);
    moved += Math.hypot(here[0] - before[0], here[1] - before[1]);
    if (fingers.size === 1) {
      if (moved > 4) { left -= (here[0] - before[0]) / zoom; top -= (here[1] - before[1]) / zoom; bounded(); }
    } else {
      const [a, b] = [...fingers.values()], apart = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (pinch) zoomAt(apart / pinch, (a[0] + b[0]) / 2, (a[1] + b[1]) / 2);
      pinch = apart; moved = 99;
    }
  });
  canvas.addEventListener("pointerup", (event) => {
    const was = fingers.delete(event.pointerId);
    if (was && !fingers.size && moved <= 4 && picture) ask(...toPanorama(...at(event)));
    pinch = 0;
  });
  canvas.addEventListener("pointercancel", (event) => { fingers.delete(event.pointerId); });
  canvas.addEventListener("pointerleave", () => { $("where").textContent = ""; });
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); if (picture) zoomAt(Math.exp(-event.deltaY / 400), ...at(event)); }, { passive: false });
  canvas.addEventListener("dblclick", (event) => zoomAt(2, ...at(event)));
  canvas.addEventListener("keydown", (event) => {
    if (!picture || event.altKey || event.ctrlKey || event.metaKey) return;
    const jump = (event.shiftKey ? .5 : .1) * Math.min(width(), height()) / zoom, middle = [width() / 2, height() / 2];
    const act = {
      ArrowLeft: () => { left -= jump; bounded(); }, ArrowRight: () => { left += jump; bounded(); },
      ArrowUp: () => { top -= jump; bounded(); }, ArrowDown: () => { top += jump; bounded(); },
      "+": () => zoomAt(1.5, ...middle), "=": () => zoomAt(1.5, ...middle), "-": () => zoomAt(1 / 1.5, ...middle), "0": fit,
      Enter: () => ask(...toPanorama(...middle)), ",": () => step(-1), ".": () => step(1), Escape: nothing,
    }[event.key];
    if (act) { event.preventDefault(); act(); }
  });
  $("in").addEventListener("click", () => zoomAt(1.5, width() / 2, height() / 2));
  $("out").addEventListener("click", () => zoomAt(1 / 1.5, width() / 2, height() / 2));
  $("fit").addEventListener("click", fit);
  $("before").addEventListener("click", () => step(-1));
  $("after").addEventListener("click", () => step(1));
  $("slider").addEventListener("input", () => choose(frames[+$("slider").value]));
  window.addEventListener("resize", () => { if (picture) bounded(); });

  // ---- start
  function open(index) {
    const one = run.shots.find((s) => s.index === index);
    shot = index; picture = one.panorama; tiles.clear(); nothing(); fit();
    document.documentElement.dataset.ready = index;
  }
  get("api/run").then((answer) => {
    run = answer;
    $("name").textContent = run.name; $("clip").textContent = run.clip; document.title = run.name + " · panorama";
    $("report").hidden = !run.report;
    const shown = run.shots.filter((s) => s.panorama);
    $("shot").replaceChildren(...run.shots.map((s) => {
      const option = document.createElement("option");
      option.value = s.index; option.disabled = !s.panorama;
      option.textContent = "shot " + s.index + ", frames " + s.first_frame + "–" + s.last_frame + (s.panorama ? "" : ": no panorama");
      return option;
    }));
    $("shot").addEventListener("change", () => open(+$("shot").value));
    if (shown.length) { $("shot").value = shown[0].index; open(shown[0].index); }
    else { $("hint").textContent = "This run has no panorama; the report says why."; document.documentElement.dataset.ready = "none"; }
  }).catch((error) => { $("hint").textContent = "The run cannot be read: " + error.message; });
})();
