"use strict";
// Values where one points, one track lit everywhere, a table that sorts, and times that a page around this one shows.
const hint = document.getElementById("hint"), root = document.body;
const data = JSON.parse(document.querySelector('script[type="application/json"]').textContent);
let lit = "";
root.dataset.live = "";

function say(text, event) {
  hint.hidden = !text; hint.textContent = text;
  if (!text) return;
  hint.style.left = `${Math.min(event.clientX + 14, innerWidth - hint.offsetWidth - 4)}px`;
  hint.style.top = `${event.clientY + 18 + hint.offsetHeight > innerHeight ? event.clientY - hint.offsetHeight - 8 : event.clientY + 18}px`;
}
const short = value => String(+value.toPrecision(3));
function place(element, event) { // the place of the pointer in the coordinates of an element
  const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(element.getScreenCTM().inverse());
  return [at.x, at.y];
}
function values(chart, event) { // the values of all lines where one points
  const [left, top, right, bottom] = chart.dataset.box.split(" ").map(Number), [most, high] = chart.dataset.scale.split(" ").map(Number);
  const lines = [...chart.querySelectorAll("polyline[data-name]")];
  if (!lines.length) return "";
  const [x, y] = place(lines[0], event);
  if (x < left - 4 || x > right + 4 || y < top - 8 || y > bottom + 8) return "";
  const found = lines.map(line => {
    const points = line.getAttribute("points").split(" ").map(point => point.split(",").map(Number));
    const [at, up] = points.reduce((a, b) => Math.abs(b[0] - x) < Math.abs(a[0] - x) ? b : a);
    return Math.abs(at - x) > (right - left) / 8 ? "" : `${line.dataset.name}: ${short((bottom - up) / (bottom - top) * high)}`;
  });
  return [`${short((x - left) / (right - left) * most)} ${chart.dataset.unit || ""}`.trim(), ...found.filter(one => one)].join("\n");
}
function ground(map, event) {
  const [x0, y0, scale] = map.dataset.ground.split(" ").map(Number), panel = map.querySelector("rect.ground"), [x, y] = place(panel, event);
  const inside = x >= 0 && y >= 0 && x <= panel.width.baseVal.value && y <= panel.height.baseVal.value;
  return inside ? `${(x0 + x * scale).toFixed(1)} m, ${(y0 + (panel.height.baseVal.value - y) * scale).toFixed(1)} m` : "";
}
addEventListener("pointermove", event => {
  const svg = event.target.closest?.("svg[data-scale], svg[data-ground]"), title = event.target.closest?.("[data-t]")?.querySelector(":scope > title");
  const track = title ? `track ${title.textContent}` : "";
  const text = !svg ? "" : svg.dataset.scale ? values(svg, event) : ground(svg, event);
  say([track, text].filter(one => one).join("\n"), event);
});

function light(key) { // show one track everywhere; the same again shows all
  lit = lit === key ? "" : key;
  root.classList.toggle("picked", lit !== "");
  for (const element of document.querySelectorAll("[data-t]")) element.classList.toggle("lit", lit !== "" && element.dataset.t.split(" ").includes(lit));
}
addEventListener("click", event => {
  const element = event.target.closest("[data-t]");
  if (element && !event.target.closest("button, a")) light(element.dataset.t.split(" ")[0]);
  else if (lit && !event.target.closest("a, button, summary, th")) light(lit);
});
addEventListener("keydown", event => { if (event.key === "Escape" && lit) light(lit); });

for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells], body = table.tBodies[0];
  table.dataset.live = "";
  heads.forEach((head, column) => {
    head.tabIndex = 0;
    const sort = () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const value = row => Number(row.cells[column].dataset.v);
      body.append(...[...body.rows].sort((a, b) => (down ? -1 : 1) * (value(a) - value(b))));
    };
    head.addEventListener("click", sort);
    head.addEventListener("keydown", event => { if (event.key === "Enter") sort(); });
  });
  const [number, role] = table.dataset.csv.split(" "), rows = data.logs[number].track_list[role], button = document.createElement("button");
  button.className = "csv"; button.textContent = "CSV of all tracks";
  button.addEventListener("click", () => {
    const link = document.createElement("a"), columns = Object.keys(rows[0]);
    const text = [columns, ...rows.map(row => columns.map(name => row[name] ?? ""))].map(line => line.join(",") + "\n").join("");
    link.href = URL.createObjectURL(new Blob([text], {type: "text/csv"})); link.download = "tracks.csv"; link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  });
  table.parentElement.after(button);
}

if (parent !== window) for (const time of document.querySelectorAll("span.at[data-ns]")) { // beside a player
  const button = document.createElement("button");
  button.className = "at"; button.textContent = time.textContent;
  button.addEventListener("click", () => parent.postMessage({at_ns: time.dataset.ns}, "*"));
  time.replaceWith(button);
}
