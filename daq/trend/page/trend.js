"use strict";
// Charts of one trend on a common time axis. Bins are numbered; bin i lies about first + (i + 1/2) * bin, ms.
(() => {
  const D = JSON.parse(document.getElementById("data").textContent);
  const COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7a4a00", "#444444"];
  const ALL = [D.first, D.first + D.bins * D.bin];
  const LEFT = 64, RIGHT = 10, TOP = 6, BOTTOM = 22;
  const TICKS_MS = [1e3, 5e3, 15e3, 6e4, 3e5, 9e5, 3.6e6, 1.08e7, 2.16e7, 4.32e7, 8.64e7, 1.728e8, 6.048e8, 1.2096e9, 2.592e9, 7.776e9, 3.1536e10];
  let domain = ALL.slice(), hover = null, drag = null;
  const time = (i) => D.first + (i + 0.5) * D.bin;
  const iso = (ms, short) => { const s = new Date(ms).toISOString(); return short ? s.slice(5, 16).replace("T", " ") : s.slice(0, 19).replace("T", " "); };
  const number = (v) => {
    if (v === null || v === undefined) return "-";
    const a = Math.abs(v);
    return a !== 0 && (a >= 1e5 || a < 1e-3) ? v.toExponential(3).replace(/\.?0*e\+?/, "e") : String(Number(v.toPrecision(5)));
  };
  const charts = [...document.querySelectorAll("figure[data-chart]")].map((figure) => {
    const own = { ...D.charts[Number(figure.dataset.chart)], figure, canvas: figure.querySelector("canvas"), off: new Set() };
    const legend = figure.querySelector(".legend");
    own.keys = own.lines.map((line, k) => {
      const button = document.createElement("button"), mark = document.createElement("i"), text = document.createElement("span");
      mark.style.background = COLOURS[k % COLOURS.length];
      button.append(mark, text);
      button.onclick = () => { own.off.has(k) ? own.off.delete(k) : own.off.add(k); button.classList.toggle("off", own.off.has(k)); draw(own); };
      legend.append(button);
      return text;
    });
    return own;
  });

  function seen(line) {  // positions in a line that are in view, with one beyond each end
    let a = line.i.findIndex((i) => time(i) >= domain[0]);
    if (a < 0) return [0, 0];
    let b = a;
    while (b < line.i.length && time(line.i[b]) <= domain[1]) b++;
    return [Math.max(0, a - 1), Math.min(line.i.length, b + 1)];
  }
  function edges(line, k) {
    if (line.h && line.h[k] !== null) return [line.v[k] - line.h[k], line.v[k] + line.h[k]];
    return line.lo ? [line.lo[k], line.hi[k]] : [line.v[k], line.v[k]];
  }
  function reach(own) {
    let low = Infinity, high = -Infinity;
    own.lines.forEach((line, n) => {
      if (own.off.has(n)) return;
      const [a, b] = seen(line);
      for (let k = a; k < b; k++) { const [l, h] = edges(line, k); low = Math.min(low, l); high = Math.max(high, h); }
    });
    if (!(low <= high)) return [0, 1];
    for (const [, limit] of own.limits) if (limit < high * 1.6 && limit > low * 0.6) { low = Math.min(low, limit); high = Math.max(high, limit); }
    const room = (high - low) * 0.06 || Math.abs(high) * 0.05 || 1;
    return [low - room, high + room];
  }
  function step(span, most) {
    const raw = span / most, ten = 10 ** Math.floor(Math.log10(raw));
    return ten * [1, 2, 5, 10].find((m) => ten * m >= raw);
  }
  function draw(own) {
    const { canvas } = own, ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
    canvas.width = w * ratio; canvas.height = h * ratio;
    const c = canvas.getContext("2d"), [y0, y1] = reach(own);
    c.scale(ratio, ratio);
    const X = (ms) => LEFT + (ms - domain[0]) / (domain[1] - domain[0]) * (w - LEFT - RIGHT);
    const Y = (v) => TOP + (y1 - v) / (y1 - y0) * (h - TOP - BOTTOM);
    c.font = "12px system-ui, sans-serif"; c.lineWidth = 1; c.strokeStyle = "#e3e7ea"; c.fillStyle = "#5b6670";
    c.textAlign = "right"; c.textBaseline = "middle";
    const dy = step(y1 - y0, 5);
    for (let v = Math.ceil(y0 / dy) * dy; v <= y1; v += dy) {
      c.beginPath(); c.moveTo(LEFT, Y(v)); c.lineTo(w - RIGHT, Y(v)); c.stroke(); c.fillText(number(Math.abs(v) < dy * 1e-6 ? 0 : v), LEFT - 6, Y(v));
    }
    c.textAlign = "center"; c.textBaseline = "top";
    const room = Math.max(2, (w - LEFT) / 110), dt = TICKS_MS.find((t) => (domain[1] - domain[0]) / t <= room) || TICKS_MS[TICKS_MS.length - 1];
    for (let t = Math.ceil(domain[0] / dt) * dt; t <= domain[1]; t += dt) {
      c.beginPath(); c.moveTo(X(t), TOP); c.lineTo(X(t), h - BOTTOM); c.stroke();
      c.fillText(dt >= 8.64e7 ? iso(t).slice(0, 10) : dt < 6e4 ? iso(t).slice(11) : iso(t, true), X(t), h - BOTTOM + 4);
    }
    c.save(); c.beginPath(); c.rect(LEFT, TOP, w - LEFT - RIGHT, h - TOP - BOTTOM); c.clip();
    for (const [name, limit] of own.limits) {
      c.strokeStyle = "#b08900"; c.setLineDash([5, 4]); c.beginPath(); c.moveTo(LEFT, Y(limit)); c.lineTo(w - RIGHT, Y(limit)); c.stroke(); c.setLineDash([]);
      c.fillStyle = "#8a6b00"; c.textAlign = "left"; c.textBaseline = "bottom"; c.fillText("zone " + name, LEFT + 4, Y(limit) - 1);
    }
    own.lines.forEach((line, n) => {
      if (own.off.has(n)) return;
      const [a, b] = seen(line), colour = COLOURS[n % COLOURS.length];
      const gaps = line.i.slice(1).map((i, k) => i - line.i[k]).sort((p, q) => p - q), usual = Math.max(1, gaps[gaps.length >> 1] || 1) * 3;
      for (let k = a; k < b;) {  // a stretch without a gap
        let e = k + 1;
        while (e < b && line.i[e] - line.i[e - 1] <= usual) e++;
        c.fillStyle = colour + "2e"; c.beginPath();
        for (let m = k; m < e; m++) c.lineTo(X(time(line.i[m])), Y(edges(line, m)[1]));
        for (let m = e - 1; m >= k; m--) c.lineTo(X(time(line.i[m])), Y(edges(line, m)[0]));
        c.closePath(); c.fill();
        c.strokeStyle = c.fillStyle = colour; c.lineWidth = 1.4; c.beginPath();
        for (let m = k; m < e; m++) c.lineTo(X(time(line.i[m])), Y(line.v[m]));
        c.stroke();
        if (e - k === 1) { c.beginPath(); c.arc(X(time(line.i[k])), Y(line.v[k]), 2, 0, 7); c.fill(); }
        k = e;
      }
    });
    for (const event of D.events) {
      if (event.time_ms < domain[0] || event.time_ms > domain[1] || !["alarm_raised", "gap"].includes(event.kind)) continue;
      const alarm = event.kind === "alarm_raised";
      c.strokeStyle = alarm ? "#D55E00" : "#9aa3aa"; c.lineWidth = alarm ? 1.5 : 1; c.beginPath();
      c.moveTo(X(event.time_ms), alarm ? TOP : h - BOTTOM - 8); c.lineTo(X(event.time_ms), h - BOTTOM); c.stroke();
    }
    if (drag) { c.fillStyle = "#0072B222"; c.fillRect(X(drag[0]), TOP, X(drag[1]) - X(drag[0]), h); }
    if (hover !== null) { c.strokeStyle = "#1d2327"; c.lineWidth = 0.7; c.beginPath(); c.moveTo(X(hover), TOP); c.lineTo(X(hover), h - BOTTOM); c.stroke(); }
    c.restore();
    own.keys.forEach((text, n) => { text.textContent = own.lines[n].name + said(own.lines[n]); });
  }
  function said(line) {  // the value nearest to the pointer
    if (hover === null) return "";
    let best = 0;
    line.i.forEach((i, k) => { if (Math.abs(time(i) - hover) < Math.abs(time(line.i[best]) - hover)) best = k; });
    if (Math.abs(time(line.i[best]) - hover) > Math.max(3 * D.bin, (domain[1] - domain[0]) / 50)) return ": -";
    const half = line.h && line.h[best] !== null ? " \u00b1 " + number(line.h[best]) : "";
    return ": " + number(line.v[best]) + half + (line.z && line.z[best] ? " (zone " + line.z[best] + ")" : "");
  }
  let asked = false;
  function redraw() {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => { asked = false; now(); });
  }
  function now() {
    charts.forEach(draw);
    document.getElementById("span").textContent = iso(domain[0]) + " to " + iso(domain[1]) + (hover === null ? "" : " | " + iso(hover));
  }
  function zoom(a, b) {
    const least = Math.max(2 * D.bin, 1000);
    if (b - a < least) { const middle = (a + b) / 2; a = middle - least / 2; b = middle + least / 2; }
    domain = [Math.max(ALL[0], a), Math.min(ALL[1], b)];
    redraw();
  }
  for (const own of charts) {
    const at = (e) => {
      const box = own.canvas.getBoundingClientRect(), share = (e.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT);
      return domain[0] + Math.min(1, Math.max(0, share)) * (domain[1] - domain[0]);
    };
    own.canvas.addEventListener("pointerdown", (e) => { drag = [at(e), at(e)]; try { own.canvas.setPointerCapture(e.pointerId); } catch { /* made by a test */ } });
    own.canvas.addEventListener("pointermove", (e) => { hover = at(e); if (drag) drag[1] = hover; redraw(); });
    own.canvas.addEventListener("pointerup", () => {
      if (!drag) return;
      const [a, b] = [Math.min(...drag), Math.max(...drag)];
      drag = null;
      if (b - a > (domain[1] - domain[0]) / 100) zoom(a, b); else redraw();
    });
    own.canvas.addEventListener("pointerleave", () => { if (!drag) { hover = null; redraw(); } });
    own.canvas.addEventListener("dblclick", () => zoom(...ALL));
  }
  for (const button of document.querySelectorAll("button[data-days]")) {
    button.onclick = () => button.dataset.days === "all" ? zoom(...ALL) : zoom(ALL[1] - Number(button.dataset.days) * 8.64e7, ALL[1]);
  }
  window.addEventListener("keydown", (e) => { if (e.key === "Escape") zoom(...ALL); });
  window.addEventListener("resize", redraw);
  now();
  document.documentElement.dataset.charts = String(charts.length);
})();
