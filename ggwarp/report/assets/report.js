"use strict";
const all = (selector, root = document) => [...root.querySelectorAll(selector)];

document.getElementById("theme")?.addEventListener("click", () => {
  const root = document.documentElement;
  const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
});

document.getElementById("boxes")?.addEventListener("change", (event) => {
  document.body.classList.toggle("boxes", event.target.checked);
});

// A chart shows its values under the pointer.
for (const chart of all(".chart")) {
  const data = JSON.parse(chart.querySelector("script").textContent);
  const svg = chart.querySelector("svg"), output = chart.querySelector("output"), cursor = chart.querySelector(".cursor");
  const height = svg.viewBox.baseVal.height;
  svg.addEventListener("pointermove", (event) => {
    const box = svg.getBoundingClientRect();
    const share = ((event.clientX - box.left) / box.width * data.width - data.left) / (data.right - data.left);
    const x = data.x0 + Math.min(1, Math.max(0, share)) * (data.x1 - data.x0);
    const nearest = data.lines.map((line) => line.rows.reduce((a, b) => Math.abs(b[0] - x) < Math.abs(a[0] - x) ? b : a));
    const at = nearest[0][0];
    cursor.setAttribute("d", `M${data.left + (at - data.x0) / (data.x1 - data.x0) * (data.right - data.left)} 0V${height}`);
    output.textContent = `${at}: ` + nearest.map((row, k) => (nearest.length > 1 ? data.lines[k].name + " " : "") + row[1]).join(", ") + ` ${data.unit}`;
  });
  svg.addEventListener("pointerleave", () => { output.textContent = ""; cursor.setAttribute("d", ""); });
}

// The stage: one frame, two of its pictures, and a seam between them.
const stage = document.querySelector(".stage");
if (stage) {
  const frames = JSON.parse(document.getElementById("frames").textContent);
  const [under, over] = all("img", stage), slider = stage.querySelector("input"), seam = stage.querySelector(".seam");
  const left = stage.querySelector(".tag.left"), right = stage.querySelector(".tag.right");
  let frame = 0, mode = "frame";
  const show = () => {
    const pictures = frames[frame].pictures;
    if (!(mode in pictures)) mode = "frame";
    over.src = pictures.render;
    under.src = pictures[mode];
    left.textContent = "render";
    right.textContent = mode;
    over.style.clipPath = `inset(0 ${100 - slider.value}% 0 0)`;
    seam.style.left = `${slider.value}%`;
    all(".modes button").forEach((button) => button.setAttribute("aria-pressed", button.value === mode));
    all(".strip button").forEach((button) => button.setAttribute("aria-pressed", Number(button.value) === frame));
  };
  all(".strip img").forEach((image, k) => { image.src = frames[k].pictures.render; });
  slider.addEventListener("input", show);
  all(".modes button").forEach((button) => button.addEventListener("click", () => { mode = button.value; show(); }));
  all(".strip button").forEach((button) => button.addEventListener("click", () => { frame = Number(button.value); show(); }));
  show();
}
