"use strict";
(async function () {
  const data = JSON.parse(document.getElementById("data").textContent);
  const canvas = document.getElementById("map"), tip = document.getElementById("tip");
  const output = document.getElementById("value"), legend = document.getElementById("legend");
  const columns = data.columns, rows = data.rows, cells = rows * columns;

  /* The data: zlib in base 64, whole numbers of 16 bits, each less the one before. */
  async function unpack(text) {
    const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
    const stream = new DecompressionStream("deflate"), writer = stream.writable.getWriter();
    writer.write(bytes);
    writer.close();
    const whole = new Int16Array(await new Response(stream.readable).arrayBuffer());
    for (let i = 1; i < cells; i++) whole[i] += whole[i - 1];
    return whole;
  }
  const shade = await unpack(data.shade);
  const layers = await Promise.all(data.layers.map(async layer => {
    const whole = await unpack(layer.values);
    const at = i => whole[i] === data.noData ? NaN : layer.offset + whole[i] * layer.step;
    return Object.assign({ at: at, picture: null }, layer);
  }));
  const named = name => layers.find(layer => layer.name === name);

  /* Words. */
  const digits = layer => layer.unit === "" ? 0 : layer.high - layer.low < 1 ? 3 : 2;
  const text = (number, layer) => number.toFixed(digits(layer)) + (layer.unit ? " " + layer.unit : "");
  function valueOf(layer, i) {
    const number = layer.at(i), by = layer.plusMinus && named(layer.plusMinus);
    if (Number.isNaN(number)) return "–";
    const error = by ? by.at(i) : NaN;
    return text(number, layer) + (Number.isNaN(error) ? "" : " ± " + text(error, by));
  }
  function say(cursor) {
    const east = data.west + (cursor.column + 0.5) * data.cell;
    const north = data.north - (cursor.row + 0.5) * data.cell;
    const places = data.cell <= 0.1 ? 2 : data.cell <= 1 ? 1 : 0;
    const i = cursor.row * columns + cursor.column;
    return [["X", east.toFixed(places)], ["Y", north.toFixed(places)]]
      .concat(layers.map(layer => [layer.name, valueOf(layer, i)]));
  }

  /* The view: the cell at the upper left corner, and pixels of the page a cell. */
  let shown = layers[0], cursor = null, view = { x: 0, y: 0, scale: 1 }, whole = 1, moved = false;
  const size = () => [canvas.clientWidth, canvas.clientHeight];
  function fit() {
    const [width, height] = size();
    whole = Math.min(width / columns, height / rows) * 0.96;
    moved = false;
    view = { scale: whole, x: (columns - width / whole) / 2, y: (rows - height / whole) / 2 };
    draw();
  }
  function zoom(factor, x, y) {
    const scale = Math.min(Math.max(view.scale * factor, whole * 0.8), 60);
    view.x += x / view.scale - x / scale;
    view.y += y / view.scale - y / scale;
    view.scale = scale;
    moved = true;
    /* a finger moves the page until the map is larger than its frame */
    canvas.style.touchAction = scale > whole * 1.05 ? "none" : "pan-y";
    draw();
  }
  function pan(x, y) {
    moved = true;
    const [width, height] = size();
    view.x = Math.min(Math.max(view.x - x / view.scale, -0.8 * width / view.scale), columns - 0.2 * width / view.scale);
    view.y = Math.min(Math.max(view.y - y / view.scale, -0.8 * height / view.scale), rows - 0.2 * height / view.scale);
    draw();
  }

  /* Pictures. */
  function pictureOf(layer) {
    if (layer.picture) return layer.picture;
    const image = new ImageData(columns, rows), n = layer.colours.length;
    for (let i = 0; i < cells; i++) {
      const number = layer.at(i), light = shade[i] ? 0.5 + 0.7 * shade[i] / 254 : 1;
      if (Number.isNaN(number) && !shade[i]) continue;
      const share = Math.min(Math.max((number - layer.low) / (layer.high - layer.low), 0), 1);
      const colour = Number.isNaN(number) ? [205, 203, 196] : layer.colours[Math.min(n - 1, Math.floor(share * n))];
      image.data.set([colour[0] * light, colour[1] * light, colour[2] * light, 255], 4 * i);
    }
    layer.picture = new OffscreenCanvas(columns, rows);
    layer.picture.getContext("2d").putImageData(image, 0, 0);
    return layer.picture;
  }
  function haloed(context, words, x, y) {
    context.lineJoin = "round"; context.lineWidth = 3.5; context.strokeStyle = "#ffffffd0";
    context.strokeText(words, x, y);
    context.fillStyle = "#16222c";
    context.fillText(words, x, y);
  }
  function drawContours(context) {
    const labels = [];
    context.lineWidth = 0.8; context.strokeStyle = "#16222cb0";
    for (const { level, line } of data.contours) {
      let long = 0;
      context.beginPath();
      for (let i = 0; i < line.length; i += 2) {
        const x = (line[i] - view.x) * view.scale, y = (line[i + 1] - view.y) * view.scale;
        if (i) { context.lineTo(x, y); long += Math.hypot(line[i] - line[i - 2], line[i + 1] - line[i - 1]); }
        else context.moveTo(x, y);
      }
      context.stroke();
      if (long * view.scale > 160) {
        const m = 2 * (line.length >> 2);
        labels.push([+level.toFixed(3) + " m", (line[m] - view.x) * view.scale, (line[m + 1] - view.y) * view.scale]);
      }
    }
    context.textAlign = "center"; context.textBaseline = "middle"; context.font = "11px system-ui, sans-serif";
    const kept = [];
    for (const [words, x, y] of labels) {
      if (kept.some(([, a, b]) => Math.abs(a - x) < 44 && Math.abs(b - y) < 16)) continue;
      kept.push([words, x, y]);
      haloed(context, words, x, y);
    }
  }
  function niceLength(most) {
    const power = Math.pow(10, Math.floor(Math.log10(most)));
    return [5, 2, 1].map(f => f * power).find(length => length <= most) || power;
  }
  function drawScaleBar(context, height) {
    const length = niceLength(140 / view.scale * data.cell), wide = length / data.cell * view.scale;
    context.fillStyle = "#ffffffd0"; context.fillRect(10, height - 40, wide + 20, 30);
    context.fillStyle = "#16222c"; context.fillRect(20, height - 20, wide, 4);
    context.fillStyle = "#ffffff"; context.fillRect(20 + wide / 2, height - 19, wide / 2 - 1, 2);
    context.font = "12px system-ui, sans-serif"; context.textAlign = "left"; context.textBaseline = "alphabetic";
    haloed(context, (length >= 1000 ? length / 1000 + " km" : +length.toPrecision(2) + " m"), 20, height - 25);
  }
  function drawNorth(context, width) {
    const x = width - 26, y = 18;
    context.fillStyle = "#ffffffd0"; context.fillRect(x - 14, y - 8, 28, 48);
    context.beginPath(); context.moveTo(x, y - 4); context.lineTo(x + 7, y + 18); context.lineTo(x, y + 13); context.lineTo(x - 7, y + 18); context.closePath();
    context.fillStyle = "#16222c"; context.fill();
    context.font = "bold 13px system-ui, sans-serif"; context.textAlign = "center"; context.textBaseline = "alphabetic";
    context.fillText("N", x, y + 34);
  }
  function draw() {
    const [width, height] = size(), ratio = window.devicePixelRatio || 1;
    if (!width) return;
    canvas.width = width * ratio; canvas.height = height * ratio;
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    context.imageSmoothingEnabled = view.scale < 1;
    context.drawImage(pictureOf(shown), -view.x * view.scale, -view.y * view.scale, columns * view.scale, rows * view.scale);
    if (document.getElementById("contours").checked) drawContours(context);
    drawScaleBar(context, height);
    drawNorth(context, width);
    if (cursor) drawCursor(context, width, height);
    else { tip.hidden = true; output.textContent = ""; }
  }
  function drawCursor(context, width, height) {
    const x = (cursor.column + 0.5 - view.x) * view.scale, y = (cursor.row + 0.5 - view.y) * view.scale;
    context.strokeStyle = "#ffffff"; context.lineWidth = 3;
    for (const style of [["#ffffff", 3], ["#16222c", 1.2]]) {
      context.strokeStyle = style[0]; context.lineWidth = style[1];
      context.beginPath();
      context.moveTo(x - 9, y); context.lineTo(x + 9, y); context.moveTo(x, y - 9); context.lineTo(x, y + 9);
      context.stroke();
    }
    const lines = say(cursor);
    tip.replaceChildren(...lines.map(([name, value]) => {
      const row = document.createElement("div"), label = document.createElement("span");
      label.textContent = name;
      row.append(label, value);
      row.className = name === shown.name ? "chosen" : "";
      return row;
    }));
    tip.hidden = x < 0 || y < 0 || x > width || y > height;
    tip.style.left = Math.max(4, x + 16 + tip.offsetWidth > width ? x - 16 - tip.offsetWidth : x + 16) + "px";
    tip.style.top = Math.max(4, Math.min(y + 16, height - tip.offsetHeight - 6)) + "px";
    output.textContent = lines.map(pair => pair.join(" ")).join(", ");
  }
  function drawLegend() {
    const stops = shown.colours.map(c => "rgb(" + c.join(",") + ")").join(",");
    legend.querySelector(".ramp").style.background = "linear-gradient(to right," + stops + ")";
    legend.querySelector(".name").textContent = shown.name + (shown.unit ? " (" + shown.unit + ")" : "");
    legend.querySelector(".ticks").replaceChildren(...Array.from({ length: shown.ticks + 1 }, (_, i) => {
      const tick = document.createElement("span");
      tick.textContent = +(shown.low + i / shown.ticks * (shown.high - shown.low)).toFixed(4);
      return tick;
    }));
  }

  /* Pointer, wheel and keys. */
  function pointAt(x, y) {
    const column = Math.floor(view.x + x / view.scale), row = Math.floor(view.y + y / view.scale);
    const inside = column >= 0 && row >= 0 && column < columns && row < rows;
    cursor = inside ? { column: column, row: row } : null;
    draw();
  }
  const fingers = new Map();
  const gap = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
  canvas.addEventListener("pointerdown", event => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.offsetX, y: event.offsetY });
    if (event.pointerType !== "mouse") pointAt(event.offsetX, event.offsetY);
  });
  canvas.addEventListener("pointermove", event => {
    const before = fingers.get(event.pointerId);
    if (!before) { pointAt(event.offsetX, event.offsetY); return; }
    const apart = fingers.size === 2 ? gap() : 0, now = { x: event.offsetX, y: event.offsetY };
    fingers.set(event.pointerId, now);
    if (fingers.size === 1) pan(now.x - before.x, now.y - before.y);
    if (apart) {
      const [a, b] = [...fingers.values()];
      zoom(gap() / apart, (a.x + b.x) / 2, (a.y + b.y) / 2);
    }
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, event => fingers.delete(event.pointerId));
  canvas.addEventListener("pointerleave", event => { if (event.pointerType === "mouse") { cursor = null; draw(); } });
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 400), event.offsetX, event.offsetY);
  }, { passive: false });
  canvas.addEventListener("dblclick", event => zoom(2, event.offsetX, event.offsetY));
  const middle = factor => { const [width, height] = size(); zoom(factor, width / 2, height / 2); };
  canvas.addEventListener("keydown", event => {
    const move = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] }[event.key];
    if (event.key === "+" || event.key === "-") middle(event.key === "+" ? 1.5 : 1 / 1.5);
    if (!move) return;
    event.preventDefault();
    const from = cursor || { row: rows >> 1, column: columns >> 1 }, step = Math.max(1, Math.round(8 / view.scale));
    cursor = {
      row: Math.min(rows - 1, Math.max(0, from.row + step * move[0])),
      column: Math.min(columns - 1, Math.max(0, from.column + step * move[1])),
    };
    draw();
  });
  document.getElementById("in").addEventListener("click", () => middle(1.5));
  document.getElementById("out").addEventListener("click", () => middle(1 / 1.5));
  document.getElementById("all").addEventListener("click", fit);
  document.getElementById("contours").addEventListener("change", draw);
  document.getElementById("contours").parentElement.hidden = !data.contours.length;
  if (data.interval) document.getElementById("interval").textContent = "Contours every " + data.interval + " m.";

  const box = document.getElementById("layers");
  layers.forEach((layer, i) => {
    const label = document.createElement("label"), choice = document.createElement("input");
    choice.type = "radio"; choice.name = "layer"; choice.checked = i === 0;
    choice.addEventListener("change", () => { shown = layer; drawLegend(); draw(); });
    label.append(choice, layer.name);
    box.append(label);
  });
  drawLegend();
  let wide = 0;
  new ResizeObserver(() => {
    /* a phone hides its bars while one scrolls: what was zoomed to stays */
    if (moved && canvas.clientWidth === wide) draw();
    else fit();
    wide = canvas.clientWidth;
  }).observe(canvas);
  window.addEventListener("beforeprint", () => { cursor = null; fit(); });
})();
