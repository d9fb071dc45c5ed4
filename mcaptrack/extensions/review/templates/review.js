"use strict";
const { root, questions, first } = JSON.parse(document.getElementById("data").textContent);
const at = (id) => document.getElementById(id);
const keys = { y: "yes", n: "no", s: "skip", u: "undo", f: "finish" };
let number = first, isBusy = false, isFinished = false;
function show() {
  const asked = isFinished ? undefined : questions[number];
  at("count").textContent = asked ? `question ${number + 1} of ${questions.length}` : "";
  at("text").textContent = asked ? asked.text
    : isFinished ? "Thank you. The log is solved again; close this page." : "That was the last question: finish.";
  at("sides").replaceChildren(...(asked ? asked.sides : []).map(({ when, jpegs }) => {
    const figure = document.createElement("figure"), caption = document.createElement("figcaption");
    caption.textContent = when;
    const pictures = document.createElement("div");
    for (const jpeg of jpegs) {
      const picture = document.createElement("img");
      picture.src = `data:image/jpeg;base64,${jpeg}`;
      picture.alt = when;
      pictures.append(picture);
    }
    if (!jpegs.length) pictures.textContent = "no picture of this can be shown";
    figure.append(caption, pictures);
    return figure;
  }));
  at("which").hidden = !asked || asked.sides.length < 2;
  at("how").hidden = isFinished;
  for (const id of ["yes", "no", "skip"]) at(id).hidden = !asked;
  at("undo").hidden = !number || isFinished;
  at("finish").hidden = isFinished;
}
async function answer(id) {
  if (isBusy || at(id).hidden) return;
  isBusy = true;
  const about = id === "undo" ? number - 1 : number;
  const name = id === "finish" ? id : `${id === "undo" ? "skip" : id}-${about}`;
  let note = "";
  try {
    const reply = await fetch(root + name, { method: "POST" });
    if (reply.ok) number = id === "undo" ? about : id === "finish" ? number : number + 1;
    else note = `This answer was not kept: ${await reply.text()}`;
  } catch {
    if (id !== "finish") note = "This answer was not kept: the command that asks has ended.";
  }
  at("note").textContent = note;
  isFinished = id === "finish";
  isBusy = false;
  show();
}
for (const id of Object.values(keys)) at(id).addEventListener("click", () => answer(id));
document.addEventListener("keydown", (event) => {
  const id = keys[event.key];
  if (id && !event.repeat && !event.ctrlKey && !event.metaKey && !event.altKey) answer(id);
});
show();
