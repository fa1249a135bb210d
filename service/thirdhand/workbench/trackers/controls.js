"use strict";
// The banner and the buttons that both pages have. A page calls its Link `link`.
const at = name => document.getElementById(name);
const SIDES = ["left", "right"];
const CELL = document.title.replace("thirdhand hands: ", "");

function showBanner({mode, headline, why, remedy}) {
  at("banner").className = mode;
  at("mode").textContent = headline;
  at("why").textContent = why;
  at("remedy").textContent = remedy;
  document.title = `${headline} - ${CELL}`;
}
// As on the live page: Resume is grey only while the arm follows, Reset unless there is something to end.
function showOrders({mode, reason}) {
  at("hold").disabled = !mode;
  at("resume").disabled = !mode || mode === "follow";
  at("reset").disabled = !(mode === "fault" || reason === "arm_not_ready");
}
function showAnswer(text, isDone) {
  at("answer").textContent = text;
  if (isDone) setTimeout(() => { if (at("answer").textContent === text) at("answer").textContent = ""; }, 8000);
}
for (const name of ["hold", "resume", "reset"])
  at(name).addEventListener("click", () => {
    at("answer").textContent = `${name} ...`;
    link.order(name);
    at(name).blur(); // the space bar holds on the page for a mouse, whatever was pressed last
  });
