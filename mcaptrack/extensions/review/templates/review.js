"use strict";
const { root, questions } = JSON.parse(document.getElementById("data").textContent);
const at = (id) => document.getElementById(id);
let number = 0, isBusy = false;
function show() {
  const one = questions[number];
  at("count").textContent = one ? `question ${number + 1} of ${questions.length}` : "";
  at("text").textContent = one ? one.text : "Thank you. The log is solved again; close this page.";
  at("sides").replaceChildren(...(one ? one.when : []).map((when, side) => {
    const figure = document.createElement("figure"), caption = document.createElement("figcaption");
    caption.textContent = one.when.length > 1 ? (side ? `from ${when}` : `until ${when}`) : `from ${when}`;
    const pictures = document.createElement("div");
    for (const jpeg of one.jpegs[side]) {
      const picture = document.createElement("img");
      picture.src = `data:image/jpeg;base64,${jpeg}`;
      picture.alt = caption.textContent;
      pictures.append(picture);
    }
    if (!one.jpegs[side].length) pictures.textContent = "no picture of this can be shown";
    figure.append(caption, pictures);
    return figure;
  }));
  for (const id of ["yes", "no", "skip"]) at(id).disabled = !one;
  at("undo").disabled = !number || !one;
}
async function answer(id) {
  if (isBusy || at(id).disabled) return;
  isBusy = true;
  const about = id === "undo" ? number - 1 : number;
  try {
    const reply = await fetch(`${root}${id === "undo" ? "skip" : id}-${about}`, { cache: "no-store" });
    if (!reply.ok) throw new Error(await reply.text());
    number = id === "undo" ? about : number + 1;
    at("note").textContent = "";
  } catch {
    at("note").textContent = "This answer was not kept: the command that asks has ended, or the log can't be written.";
  }
  isBusy = false;
  show();
}
for (const id of ["yes", "no", "skip", "undo"]) at(id).addEventListener("click", () => answer(id));
document.addEventListener("keydown", (event) => {
  const id = { y: "yes", n: "no", s: "skip", u: "undo" }[event.key];
  if (id && !event.ctrlKey && !event.metaKey && !event.altKey) answer(id);
});
show();
