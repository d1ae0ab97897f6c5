/* Curves, status strip and frame outlines of report.html, from the JSON block; one cursor for all of them.
   Units as in camera.csv. A null is an empty cell and stays a gap. Needs uPlot, and nothing from outside the page. */
(function () {
  "use strict";
  const data = JSON.parse(document.getElementById("data").textContent);
  const C = data.columns, n = data.frame.length;
  document.documentElement.dataset.rows = n;
  if (!n) return;
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
  const LEFT = 56, RIGHT = 14; // px beside the plots: strip and curves share them

  // ---- data as uPlot wants it: a null point between two shots keeps the line from joining them
  const x = [], rowAt = [];
  for (let i = 0; i < n; i++) {
    if (i && data.shot[i] !== data.shot[i - 1]) { x.push((data.frame[i] + data.frame[i - 1]) / 2); rowAt.push(-1); }
    x.push(data.frame[i]); rowAt.push(i);
  }
  const pointAt = []; rowAt.forEach((row, k) => { if (row >= 0) pointAt[row] = k; });
  const spread = (values) => rowAt.map((row) => (row < 0 ? null : values[row]));
  const offset = (k) => spread(C.f_px.map((f, i) => (f === null || C.f_std_px[i] === null ? null : f + k * C.f_std_px[i])));

  const fixed = (v, digits) => v.toFixed(digits).replace("-", "−");
  const signed = (v, digits) => (v > 0 ? "+" : "") + fixed(v, digits);
  const CHARTS = [
    { key: "f_px", title: "Focal length, px", height: 220, none: "No focal length is claimed in any frame; the summary says why.",
      text: (i) => fixed(C.f_px[i], 1) + (C.f_std_px[i] === null ? "" : " ± " + fixed(C.f_std_px[i], 1)) + " px" },
    { key: "zoom_ratio", title: "Zoom ratio to the shot's reference frame", height: 130, text: (i) => "×" + fixed(C.zoom_ratio[i], 4) },
    { key: "pan_deg", title: "Pan, degrees (right positive)", height: 130, text: (i) => signed(C.pan_deg[i], 3) + "°" },
    { key: "tilt_deg", title: "Tilt, degrees (up positive)", height: 130, text: (i) => signed(C.tilt_deg[i], 3) + "°" },
    { key: "roll_deg", title: "Roll, degrees (clockwise positive)", height: 130, text: (i) => signed(C.roll_deg[i], 3) + "°" },
    { key: "residual_px", title: "Residual, px", height: 130, text: (i) => fixed(C.residual_px[i], 3) + " px" },
  ];

  // ---- the cursor: one selected row, shown by every part of the page
  let selected = -1, placing = false;
  const listeners = [];
  function select(row) {
    row = Math.max(0, Math.min(n - 1, row));
    if (row === selected) return;
    selected = row;
    listeners.forEach((f) => f(row));
  }
  function rowNear(frame) { // nearest drawn row to a frame number
    let lo = 0, hi = n - 1;
    while (lo < hi) { const mid = (lo + hi) >> 1; if (data.frame[mid] < frame) lo = mid + 1; else hi = mid; }
    return lo && frame - data.frame[lo - 1] < data.frame[lo] - frame ? lo - 1 : lo;
  }
  function runOf(row) { // the run (status, reason) that a drawn row lies in
    const at = data.row[row];
    let lo = 0, hi = data.runs.length - 1;
    while (lo < hi) { const mid = (lo + hi + 1) >> 1; if (data.runs[mid][0] <= at) lo = mid; else hi = mid - 1; }
    return data.runs[lo];
  }

  // ---- curves
  const holder = document.getElementById("charts");
  const plots = [];
  const isolated = (u, series, show, gaps) => { // a value between two empty cells has no line: draw its point
    const y = u.data[series], out = [];
    for (let k = 0; k < y.length; k++) if (y[k] !== null && (k === 0 || y[k - 1] === null) && (k === y.length - 1 || y[k + 1] === null)) out.push(k);
    return out;
  };
  let printing = false;
  const width = () => Math.max(260, printing ? Math.min(holder.clientWidth, 680) : holder.clientWidth); // 680: A4 in CSS px
  let axisFrom = data.frame[0], axisTo = Math.max(data.frame[n - 1], axisFrom + 1), zooming = false;
  const full = [axisFrom, axisTo];
  for (const spec of CHARTS) {
    const box = document.createElement("div");
    box.className = "chart";
    const head = document.createElement("h3"), value = document.createElement("span");
    head.append(spec.title, value); value.className = "value"; box.append(head); holder.append(box);
    if (!C[spec.key].some((v) => v !== null)) {
      const p = document.createElement("p");
      p.className = "none"; p.textContent = spec.none || "Not known in any frame."; box.append(p);
      continue;
    }
    listeners.push((i) => { value.textContent = C[spec.key][i] === null ? "not known" : spec.text(i); });
    // pxAlign 0: rounded to whole pixels, a slow pan would look like stairs.
    const line = { stroke: () => css("accent"), width: 1.5, pxAlign: 0, points: { show: true, size: 4, filter: isolated } };
    const edge = { stroke: "transparent", width: 0, points: { show: false } };
    const focal = spec.key === "f_px";
    const options = {
      width: width(), height: spec.height, padding: [8, RIGHT, 0, 0], legend: { show: false },
      scales: { x: { time: false, range: (u, from, to) => [from ?? full[0], to ?? full[1]] } },
      cursor: { y: false, points: { show: true }, drag: { x: true, y: false } },
      axes: [
        { stroke: () => css("dim"), grid: { stroke: () => css("grid"), width: 1 }, ticks: { stroke: () => css("line"), width: 1 }, size: 28, font: "11px system-ui, sans-serif" },
        { stroke: () => css("dim"), grid: { stroke: () => css("grid"), width: 1 }, ticks: { stroke: () => css("line"), width: 1 }, size: LEFT, font: "11px system-ui, sans-serif", space: 26 },
      ],
      series: focal ? [{}, edge, edge, edge, edge, line] : [{}, line],
      bands: focal ? [{ series: [1, 2], fill: () => css("band95") }, { series: [3, 4], fill: () => css("band68") }] : [],
      hooks: {
        setCursor: [(u) => {
          if (placing) return;
          const k = u.cursor.idx;
          if (k === null || k === undefined) { requestAnimationFrame(place); return; }
          select(rowAt[k] < 0 ? rowAt[k + 1] : rowAt[k]);
        }],
        setScale: [(u, key) => {
          if (key !== "x" || zooming) return;
          zooming = true;
          axisFrom = u.scales.x.min; axisTo = u.scales.x.max;
          plots.forEach((p) => { if (p !== u) p.setScale("x", { min: axisFrom, max: axisTo }); });
          zooming = false;
          drawStrip(); drawFilm(); place();
        }],
      },
    };
    const columns = focal ? [x, offset(1.96), offset(-1.96), offset(1), offset(-1), spread(C.f_px)] : [x, spread(C[spec.key])];
    const plot = new uPlot(options, columns, box);
    plot.root.setAttribute("role", "img");
    plot.root.setAttribute("aria-label", spec.title + " over the frames" + (focal ? ", with the bands that hold 68 and 95 per cent" : "") + ". All values are in camera.csv.");
    plots.push(plot);
  }
  function place() {
    if (selected < 0) return;
    placing = true;
    plots.forEach((u) => u.setCursor({ left: u.valToPos(x[pointAt[selected]], "x"), top: 1 }, false, false));
    placing = false;
  }
  listeners.push(place);

  // ---- the status strip: colour and pattern; a pixel shows the worst of its frames
  const WORST = ["ok", "relative", "weak", "interpolated", "graphic", "lost"];
  const HEIGHT = { ok: 1, weak: .8, relative: .8, interpolated: .6, graphic: .5, lost: .45 };
  function paint(ctx, status, left, top, w, h) {
    const tall = Math.round(h * (HEIGHT[status] || 1));
    ctx.save();
    ctx.beginPath(); ctx.rect(left, top + h - tall, w, tall); ctx.clip();
    ctx.fillStyle = css(status) || css("dim"); ctx.fillRect(left, top, w, h);
    ctx.strokeStyle = css("paper"); ctx.lineWidth = 1.4; ctx.beginPath();
    const slant = (step, dir) => { for (let k = Math.floor((left - h) / step) * step; k < left + w + h; k += step) { ctx.moveTo(k, dir > 0 ? top + h : top); ctx.lineTo(k + h, dir > 0 ? top : top + h); } };
    if (status === "weak") slant(6, 1);
    if (status === "lost") { slant(6, 1); slant(6, -1); }
    if (status === "relative") for (let y = top + 2.5; y < top + h; y += 5) { ctx.moveTo(left, y); ctx.lineTo(left + w, y); }
    if (status === "graphic") for (let k = Math.ceil(left / 4) * 4; k < left + w; k += 4) { ctx.moveTo(k, top); ctx.lineTo(k, top + h); }
    if (status === "interpolated") { ctx.setLineDash([2, 4]); for (let y = top + 2; y < top + h; y += 4) { ctx.moveTo(Math.floor(left / 6) * 6, y); ctx.lineTo(left + w, y); } }
    ctx.stroke(); ctx.restore();
  }
  function prepare(canvas, w, h) {
    const ratio = window.devicePixelRatio || 1, ctx = canvas.getContext("2d");
    canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0); ctx.clearRect(0, 0, w, h);
    return ctx;
  }
  const strip = document.getElementById("strip"), base = document.createElement("canvas"); // base: the strip without cursor
  // Frame number of a run's first row: rows are frames from the table's first one on.
  const runFrame = (run) => data.frame[0] + run[0];
  function drawStrip() {
    const w = width(), ctx = prepare(base, w, 46), plotWidth = w - LEFT - RIGHT, scale = plotWidth / (axisTo - axisFrom);
    const worst = new Int8Array(Math.max(1, Math.floor(plotWidth))).fill(-1);
    let band = 0, shotStart = 0;
    ctx.font = "11px system-ui, sans-serif"; ctx.textBaseline = "middle";
    data.runs.forEach((run, k) => {
      const from = (runFrame(run) - axisFrom) * scale, to = (runFrame(run) + run[1] - axisFrom) * scale;
      const rank = WORST.indexOf(data.statuses[run[2]]);
      for (let p = Math.max(0, Math.floor(from)); p < Math.min(worst.length, Math.max(to, from + 1)); p++) worst[p] = Math.max(worst[p], rank);
      const next = data.runs[k + 1];
      if (!next || next[4] !== run[4]) { // a shot ends here
        const left = Math.max(0, (runFrame(data.runs[shotStart]) - axisFrom) * scale), right = Math.min(plotWidth, to);
        if (run[4] >= 0 && right > left) {
          ctx.fillStyle = css(band++ % 2 ? "line" : "grid"); ctx.fillRect(LEFT + left, 0, Math.max(1, right - left), 15);
          ctx.fillStyle = css("ink");
          const label = (right - left > 46 ? "shot " : "") + run[4];
          if (right - left > 12) ctx.fillText(label, LEFT + left + 4, 8);
        }
        shotStart = k + 1;
      }
    });
    for (let p = 0, start = 0; p <= worst.length; p++) {
      if (p < worst.length && worst[p] === worst[start]) continue;
      if (worst[start] >= 0) paint(ctx, WORST[worst[start]], LEFT + start, 18, p - start, 27);
      start = p;
    }
    ctx.fillStyle = css("dim"); ctx.fillText("status", 4, 32); ctx.fillText("shots", 4, 8);
    drawStripCursor();
  }
  function drawStripCursor() {
    const w = width(), ctx = prepare(strip, w, 46);
    strip.style.width = w + "px";
    ctx.drawImage(base, 0, 0, w, 46);
    if (selected < 0) return;
    const at = LEFT + (data.frame[selected] - axisFrom) * (w - LEFT - RIGHT) / (axisTo - axisFrom);
    if (at >= LEFT && at <= w - RIGHT) { ctx.fillStyle = css("ink"); ctx.fillRect(at - .5, 0, 1.5, 46); }
  }
  function fromStrip(event) {
    const at = event.clientX - strip.getBoundingClientRect().left - LEFT;
    select(rowNear(axisFrom + (at / (width() - LEFT - RIGHT)) * (axisTo - axisFrom)));
  }
  strip.addEventListener("pointermove", fromStrip); strip.addEventListener("pointerdown", fromStrip);
  listeners.push(drawStripCursor);
  function drawSwatches() {
    document.querySelectorAll(".swatch").forEach((canvas) => paint(prepare(canvas, 28, 14), canvas.dataset.status, 0, 0, 28, 14));
  }

  // ---- the film strip: pictures of the clip at their place over the curves
  const film = document.getElementById("film"), SLOT = 92; // px for a picture
  const thumbFrames = Object.keys(data.thumbnails).map(Number).sort((a, b) => a - b);
  function nearest(sorted, frame) { // of ascending numbers
    let lo = 0, hi = sorted.length - 1;
    while (lo < hi) { const mid = (lo + hi) >> 1; if (sorted[mid] < frame) lo = mid + 1; else hi = mid; }
    return lo && frame - sorted[lo - 1] < sorted[lo] - frame ? sorted[lo - 1] : sorted[lo];
  }
  function drawFilm() {
    film.hidden = thumbFrames.length < 2;
    if (film.hidden) return;
    const plotWidth = width() - LEFT - RIGHT, slots = Math.max(1, Math.floor(plotWidth / SLOT)), step = (axisTo - axisFrom) / slots;
    const pictures = [];
    for (let k = 0; k < slots; k++) {
      // Half a slot early or late is near enough to stand here: keyframes do not come at even times.
      const from = axisFrom + k * step, frame = nearest(thumbFrames, from + step / 2);
      const own = frame >= from - step / 2 && frame <= from + 1.5 * step && !pictures.some((p) => +p.dataset.frame === frame);
      const picture = document.createElement("img");
      picture.src = data.thumbnails[frame]; picture.alt = ""; picture.draggable = false;
      // Where no picture was kept the nearest one stands in, faint: no hole, and no picture of another time in full.
      if (own) { picture.title = "frame " + frame; picture.dataset.frame = frame; }
      else { picture.title = "no picture kept here; the nearest is of frame " + frame; picture.className = "near"; }
      picture.style.left = LEFT + k * plotWidth / slots + "px"; picture.style.width = plotWidth / slots - 3 + "px";
      pictures.push(picture);
    }
    film.replaceChildren(...pictures);
    markFilm();
  }
  function markFilm() {
    const pictures = [...film.children].filter((picture) => picture.dataset.frame);
    if (!pictures.length || selected < 0) return;
    const now = nearest(pictures.map((picture) => +picture.dataset.frame), data.frame[selected]);
    pictures.forEach((picture) => picture.classList.toggle("now", +picture.dataset.frame === now));
  }
  film.addEventListener("pointermove", fromStrip); film.addEventListener("pointerdown", fromStrip);
  listeners.push(markFilm);

  // ---- outlines on the panoramas
  const FAINT = 24; // outlines of a shot that are always there
  document.querySelectorAll(".pano").forEach((pano) => {
    const shot = +pano.dataset.shot, outlines = data.outlines[shot] || {}, svg = pano.querySelector("svg");
    const frames = Object.keys(outlines).map(Number).sort((a, b) => a - b);
    if (!frames.length) return;
    const points = (frame) => outlines[frame].map((p) => p.join(",")).join(" ");
    const middle = (corners) => [0, 1].map((c) => corners.reduce((sum, p) => sum + p[c], 0) / corners.length);
    const middles = frames.map((frame) => middle(outlines[frame]));
    const holds = (corners, x, y) => { // whether a point is inside: edges crossed to its right, odd or even
      let inside = false;
      for (let a = corners.length - 1, b = 0; b < corners.length; a = b++) {
        const [xa, ya] = corners[a], [xb, yb] = corners[b];
        if (ya > y !== yb > y && x < ((xb - xa) * (y - ya)) / (yb - ya) + xa) inside = !inside;
      }
      return inside;
    };
    const fromPano = (event) => { // of the frames that see the point, the one that has it nearest to its middle
      const box = svg.getBoundingClientRect(), full = svg.viewBox.baseVal;
      const x = ((event.clientX - box.left) / box.width) * full.width, y = ((event.clientY - box.top) / box.height) * full.height;
      let best = -1, away = Infinity;
      frames.forEach((frame, k) => {
        const d = Math.hypot(middles[k][0] - x, middles[k][1] - y);
        if (d < away && holds(outlines[frame], x, y)) { best = frame; away = d; }
      });
      if (best >= 0) select(rowNear(best));
    };
    pano.addEventListener("pointermove", fromPano); pano.addEventListener("pointerdown", fromPano);
    const step = Math.ceil(frames.length / FAINT);
    svg.innerHTML = frames.filter((_, k) => k % step === 0).map((f) => '<polygon class="faint" points="' + points(f) + '"/>').join("") +
      '<polygon class="halo"/><polygon class="now"/>';
    listeners.push((row) => {
      // A frame without a camera has no place in the panorama, whatever its neighbours have.
      const here = data.shot[row] === shot && C.zoom_ratio[row] !== null, frame = data.frame[row];
      const near = here && nearest(frames, frame);
      svg.querySelectorAll(".halo, .now").forEach((polygon) => polygon.setAttribute("points", here ? points(near) : ""));
    });
  });

  // ---- the bar at the foot: slider, words, thumbnail
  const slider = document.getElementById("slider"), readout = document.getElementById("readout"), thumb = document.getElementById("cursor-thumb");
  slider.max = n - 1;
  slider.addEventListener("input", () => select(+slider.value));
  listeners.push((row) => {
    const run = runOf(row), status = data.statuses[run[2]], reason = data.reasons[run[3]];
    const parts = ["frame " + data.frame[row]];
    if (C.pts_s[row] !== null) parts.push(fixed(C.pts_s[row], 3) + " s");
    if (data.timecode[row]) parts.push(data.timecode[row]);
    parts.push(data.shot[row] < 0 ? "between shots" : "shot " + data.shot[row]);
    parts.push((data.signs[status] || "?") + " " + status + (reason ? ": " + data.reason_words[reason] : ""));
    const known = (key, words) => { if (C[key][row] !== null) parts.push(words(C[key][row])); };
    if (C.f_px[row] !== null) parts.push("f " + CHARTS[0].text(row));
    known("zoom_ratio", (v) => "zoom ×" + fixed(v, 3));
    known("pan_deg", (v) => "pan " + signed(v, 2) + "°"); known("tilt_deg", (v) => "tilt " + signed(v, 2) + "°"); known("roll_deg", (v) => "roll " + signed(v, 2) + "°");
    known("residual_px", (v) => "residual " + fixed(v, 2) + " px"); known("overlap", (v) => "overlap " + fixed(100 * v, 0) + " %");
    readout.replaceChildren(...parts.map((text, k) => {
      const span = document.createElement("span");
      if (k === 0) { const bold = document.createElement("b"); bold.textContent = text; span.append(bold); } else span.textContent = text;
      return span;
    }));
    slider.value = row; slider.setAttribute("aria-valuetext", parts.join(", "));
    if (thumbFrames.length) {
      const near = nearest(thumbFrames, data.frame[row]);
      if (thumb.alt !== "Frame " + near) thumb.src = data.thumbnails[near];
      thumb.alt = "Frame " + near; thumb.hidden = false;
    }
  });
  document.addEventListener("keydown", (event) => {
    if (event.altKey || event.ctrlKey || event.metaKey || (event.target.closest && event.target.closest("input:not(#slider), .wide, textarea, select"))) return;
    const step = event.shiftKey ? 10 : 1;
    const to = { ArrowLeft: selected - step, ArrowRight: selected + step, Home: 0, End: n - 1 }[event.key];
    if (to === undefined) return;
    event.preventDefault(); select(to);
  });

  // ---- size, theme, paper
  function redraw() { drawSwatches(); drawStrip(); drawFilm(); plots.forEach((u) => u.redraw()); place(); }
  function resize(w) { plots.forEach((u) => u.setSize({ width: w, height: u.height })); redraw(); }
  let last = width();
  window.addEventListener("resize", () => { if (width() !== last) { last = width(); resize(last); } });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  // Before the browser lays the page out for paper: what is wider than that would shrink everything.
  const paper = (on) => { if (printing !== on) { printing = on; resize(width()); } };
  window.addEventListener("beforeprint", () => paper(true)); window.addEventListener("afterprint", () => paper(false));
  matchMedia("print").addEventListener("change", (event) => paper(event.matches));
  window.addEventListener("beforeprint", () => document.querySelectorAll("section.shot > details").forEach((d) => { d.open = true; }));
  document.getElementById("cursor").hidden = false;
  drawSwatches(); drawStrip(); drawFilm();
  // report.html#frame=120 opens at that frame, or the nearest one that is drawn.
  const fromAddress = () => {
    const wanted = /^#frame=(\d+)$/.exec(location.hash);
    if (wanted) select(data.frame.reduce((best, frame, row) => (Math.abs(frame - wanted[1]) < Math.abs(data.frame[best] - wanted[1]) ? row : best), 0));
    return wanted !== null;
  };
  window.addEventListener("hashchange", fromAddress);
  if (!fromAddress()) select(0);
  document.documentElement.dataset.ready = plots.length;
})();
