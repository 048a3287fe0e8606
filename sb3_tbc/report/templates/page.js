"use strict";
// Everything is drawn without this script; it adds filters, the pointer's reading, and the choice of colours.
const all = (selector, root = document) => Array.from(root.querySelectorAll(selector));

const theme = document.getElementById("theme");
theme.hidden = false;
theme.addEventListener("click", () => {
  const root = document.documentElement;
  const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
});

function show(section, method, visible) {
  for (const group of all("g.method", section)) {
    if (group.dataset.method === method) group.classList.toggle("hidden", !visible);
  }
}

for (const section of all(".figures > section")) {
  const svg = section.querySelector("svg.curves");
  for (const label of all(".key label", section)) {
    const box = label.querySelector("input");
    box.disabled = false;
    box.addEventListener("change", () => show(section, box.value, box.checked));
    const focus = (on) => {
      svg.classList.toggle("focused", on && box.checked);
      for (const group of all("g.method", svg)) group.classList.toggle("focus", on && group.dataset.method === box.value);
    };
    for (const [name, on] of [["mouseenter", true], ["mouseleave", false], ["focusin", true], ["focusout", false]]) {
      label.addEventListener(name, () => focus(on));
    }
  }
  read(section, svg);
}

// The measured point nearest to the pointer: method, seed, step and success rate.
function read(section, svg) {
  const said = section.querySelector(".said");
  const mark = document.createElementNS("http://www.w3.org/2000/svg", "circle");
  mark.setAttribute("class", "cross");
  mark.setAttribute("r", "5");
  const [left, right, top, bottom] = svg.closest("[data-frame]").dataset.frame.split(" ").map(Number);
  svg.addEventListener("pointermove", (event) => {
    const place = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    let best = null;
    for (const group of all("g.method:not(.hidden)", svg)) {
      for (const seed of all(".seed", group)) {
        for (const dot of seed.querySelectorAll("circle")) {
          const x = +dot.getAttribute("cx"), y = +dot.getAttribute("cy");
          const distance = Math.hypot(x - place.x, y - place.y);
          if (!best || distance < best.distance) best = { distance, x, y, group, seed };
        }
      }
    }
    if (!best) return;
    const steps = Math.round((best.x - left) / (right - left) * svg.dataset.xMax / 100) * 100;
    const rate = (bottom - best.y) / (bottom - top);
    mark.setAttribute("cx", best.x);
    mark.setAttribute("cy", best.y);
    svg.append(mark);
    said.textContent = `${best.group.dataset.method}, seed ${best.seed.dataset.seed}: ` +
      `${rate.toFixed(2)} at about ${steps.toLocaleString("en")} steps`;
  });
  svg.addEventListener("pointerleave", () => { mark.remove(); said.textContent = ""; });
}

const variants = document.getElementById("variants");
variants.disabled = false;
variants.addEventListener("change", () => {
  for (const row of all("tr.variant, details.variant, .key .variant")) row.hidden = !variants.checked;
  for (const section of all(".figures > section")) {
    for (const label of all(".key .variant", section)) {
      const box = label.querySelector("input");
      box.checked = variants.checked;
      show(section, box.value, variants.checked);
    }
  }
});
