"use strict";
const by = id => document.getElementById(id), canvas = by("canvas"), pen = canvas.getContext("2d");
const files = by("pictures").textContent.trim().split(" ").filter(one => one), images = new Map();
let data, now = 0, playing = false, clock = 0, last = 0, hidden = new Set(), boxes = new Map(), events = [], places = [], page = null, asked = null;

function image(number) { // the picture, decoded; those used last are kept
  let one = images.get(number);
  images.delete(number);
  if (!one) {
    one = new Image();
    one.src = "data:image/jpeg;base64," + files[number];
    one.decode().then(() => { one.ready = true; if (number === now) paint(); }, () => { one.ready = true; });
  }
  images.set(number, one);
  if (images.size > 48) images.delete(images.keys().next().value);
  return one;
}
function paint() {
  const ratio = devicePixelRatio || 1, wide = Math.round(canvas.clientWidth * ratio), high = Math.round(canvas.clientHeight * ratio);
  const [w, h] = data.sizes[now], scale = Math.min(wide / w, high / h), shown = files.length ? image(now) : null;
  if (shown && !shown.ready && !(wide !== canvas.width || high !== canvas.height)) return; // what is there stays until the picture is decoded
  canvas.width = wide; canvas.height = high;
  pen.save();
  pen.translate((wide - w * scale) / 2, 0);
  pen.beginPath(); pen.rect(0, 0, w * scale, h * scale); pen.clip();
  if (shown) pen.drawImage(shown, 0, 0, w * scale, h * scale);
  else { pen.fillStyle = data.ground; pen.fillRect(0, 0, w * scale, h * scale); }
  data.layers.forEach((layer, k) => { if (!hidden.has(layer)) strokes(data.drawn[now][k], scale, ratio); });
  pen.restore();
}
function strokes([lines, texts], scale, ratio) {
  for (const [kind, thickness, colour, fill, at] of lines) {
    pen.beginPath();
    for (let k = 0; k < at.length; k += 2) pen[k && !(kind === 2 && k % 4 === 0) ? "lineTo" : "moveTo"](at[k] * scale, at[k + 1] * scale);
    if (kind === 0) pen.closePath();
    if (fill >= 0) { pen.fillStyle = data.colours[fill]; pen.fill(); }
    if (colour >= 0) { pen.strokeStyle = data.colours[colour]; pen.lineWidth = Math.max(ratio, thickness * scale); pen.stroke(); }
  }
  for (const [x, y, size, colour, ground, text] of texts) {
    const px = Math.max(10 * ratio, size * scale);
    pen.font = `${px}px system-ui, "DejaVu Sans", sans-serif`;
    const wide = pen.measureText(text).width, low = Math.max(y * scale, 1.2 * px);
    if (ground >= 0) { pen.fillStyle = data.colours[ground]; pen.fillRect(x * scale, low - 1.2 * px, wide + px / 2, 1.2 * px); }
    if (colour >= 0) { pen.fillStyle = data.colours[colour]; pen.fillText(text, x * scale + px / 4, low - 0.28 * px); }
  }
}
function show(number) {
  now = Math.max(0, Math.min(data.seconds.length - 1, number));
  by("at").value = now;
  const time = data.seconds[now], event = events.filter(([at]) => at <= time + 0.001 && at > time - 2).pop();
  by("time").textContent = `${time.toFixed(2)} / ${data.seconds[data.seconds.length - 1].toFixed(2)} s`;
  by("at").setAttribute("aria-valuetext", `${time.toFixed(2)} s, picture ${data.numbers[now]}`);
  by("at").title = `picture ${data.numbers[now]}`;
  by("event").textContent = event ? event[1] : "";
  by("back").disabled = !places.some(one => one < now);
  by("next").disabled = !places.some(one => one > now);
  if (files.length) for (let k = 1; k < 6 && now + k < files.length; k++) image(now + k);
  paint();
  if (page) page.postMessage({player: {at_s: time}}, "*");
}
function mark() { // the events of the tracks that are drawn, and the pictures at which they happen
  const count = data.seconds.length;
  events = data.events.filter(([, , layer]) => !hidden.has(data.layers[layer]));
  places = events.map(([at]) => numberAt(at));
  document.documentElement.classList.toggle("events", events.length > 0);
  for (const id of ["back", "next"]) by(id).hidden = !events.length;
  by("marks").replaceChildren(...events.map(([, text], k) => {
    const mark = document.createElement("button");
    mark.style.left = `${100 * places[k] / Math.max(1, count - 1)}%`; mark.title = text; mark.tabIndex = -1; mark.setAttribute("aria-label", text);
    mark.addEventListener("click", () => go(places[k]));
    return mark;
  }));
}
function numberAt(second) { // the first picture that is not before a time
  const k = data.seconds.findIndex(one => one >= second - 0.001);
  return k < 0 ? data.seconds.length - 1 : k;
}
function play(on) {
  playing = on;
  if (on && now === data.seconds.length - 1) show(0);
  clock = data.seconds[now]; last = performance.now();
  by("sign").setAttribute("d", on ? "M3 1.5h3.5v13H3zM9.5 1.5H13v13H9.5z" : "M3 1.5v13l11-6.5z");
  by("play").setAttribute("aria-label", on ? "Pause" : "Play");
  if (on) requestAnimationFrame(step);
}
function step(time) {
  if (!playing) return;
  clock += Math.max(0, time - last) / 1000 * +by("speed").value; last = time;
  let to = now;
  while (to + 1 < data.seconds.length && data.seconds[to + 1] <= clock) to++;
  if (to !== now) { if (files.length && !image(to).ready) clock = data.seconds[to]; show(to); }
  if (to === data.seconds.length - 1) play(false); else requestAnimationFrame(step);
}
function go(number) { play(false); show(number); }
function toEvent(side) {
  const found = side > 0 ? places.find(one => one > now) : places.filter(one => one < now).pop();
  if (found !== undefined) go(found);
}
function draw(layer, on) {
  hidden[on ? "delete" : "add"](layer); boxes.get(layer).checked = on;
  mark(); show(now);
}
function obey({at_s, tracks}) { // what a page around it asks for: a time, and the tracks that are drawn
  const chosen = data.layers[data.tracks[tracks]];
  if (chosen && hidden.has(chosen)) for (const k of Object.values(data.tracks)) draw(data.layers[k], data.layers[k] === chosen);
  if (typeof at_s === "number") go(numberAt(at_s)); else show(now);
}
addEventListener("message", event => {
  if (event.source !== parent || parent === window || typeof event.data?.show !== "object") return;
  page = parent; asked = event.data.show;
  if (data) obey(asked);
});
function start() {
  const count = data.seconds.length;
  by("at").max = count - 1;
  hidden = new Set(data.hidden.map(k => data.layers[k]));
  for (const layer of data.layers.filter(one => one)) {
    const label = document.createElement("label"), box = document.createElement("input");
    box.type = "checkbox"; box.checked = !hidden.has(layer); label.title = layer; label.append(box, data.names[layer]);
    box.addEventListener("change", () => draw(layer, box.checked));
    boxes.set(layer, box);
    by("layers").append(label);
  }
  mark();
  by("play").addEventListener("click", () => play(!playing));
  by("at").addEventListener("input", () => go(+by("at").value));
  by("speed").addEventListener("change", () => { clock = data.seconds[now]; });
  by("back").addEventListener("click", () => toEvent(-1)); by("next").addEventListener("click", () => toEvent(1));
  canvas.addEventListener("click", () => play(!playing));
  const keys = {
    ArrowLeft: e => go(now - (e.shiftKey ? 10 : 1)), ArrowRight: e => go(now + (e.shiftKey ? 10 : 1)), Home: () => go(0), End: () => go(count - 1),
    p: () => toEvent(-1), n: () => toEvent(1), " ": () => play(!playing),
  };
  addEventListener("keydown", event => {
    const key = keys[event.key], tag = event.target.tagName;
    if (!key || event.ctrlKey || event.metaKey || event.altKey || tag === "SELECT" || (event.key === " " && (tag === "BUTTON" || event.target.type === "checkbox"))) return;
    event.preventDefault(); key(event);
  });
  addEventListener("resize", paint);
  by("stage").style.aspectRatio = Math.min(...data.sizes.map(([w, h]) => w / h)); // what it is controlled with stands right below it
  document.documentElement.classList.add("ready");
  show(data.open);
  if (asked) obey(asked);
}
(async () => {
  const packed = Uint8Array.from(atob(by("data").textContent.trim()), one => one.charCodeAt(0));
  const whole = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  data = JSON.parse(await new Response(whole).text());
  start();
})();
