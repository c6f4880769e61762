"use strict";
// figures are drawn when they come near the screen, in the colors of light or dark, for the width that there is
const darkness = matchMedia("(prefers-color-scheme: dark)");
const darkened = JSON.parse(document.getElementById("dark").textContent);

function inColors(text) {
  return darkness.matches ? text.replace(/#[0-9a-f]{6}\b/gi, (color) => darkened[color.toLowerCase()] || color) : text;
}

async function library() {
  if (window.Plotly) return;
  const packed = document.getElementById("packed");
  if (!packed) throw new Error("the script of the figures, which stands beside the folders of runs, is not there");
  if (!window.DecompressionStream) throw new Error("this browser is too old to unpack the script of the figures");
  const bytes = Uint8Array.from(atob(packed.textContent), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(stream).text();
  document.head.append(script);
}

function fitted({ data, layout }, width) {
  if (width > 560) return layout;
  layout.font = { ...layout.font, size: 11 };
  layout.margin = { ...layout.margin, l: Math.min(layout.margin.l, 46), r: Math.min(layout.margin.r, 16) };
  for (const name of Object.keys(layout).filter((key) => /^[xy]axis/.test(key))) {
    const listed = layout[name].categoryarray || layout[name].tickvals || layout[name].type === "category";
    const size = listed && (layout[name].tickvals || []).length > 10 ? 8 : 10;
    if (layout[name].dtick === "D2") layout[name].dtick = 1; // a tick for every power of ten has room
    layout[name] = { ...layout[name], nticks: listed ? 0 : layout[name].nticks || 5, tickfont: { ...layout[name].tickfont, size } };
  }
  // what stands beside a figure has no room
  const beside = (entry) => entry.xref === "paper" && entry.x > 1;
  if ((layout.annotations || []).some(beside)) layout.margin.r = 52;
  layout.annotations = (layout.annotations || []).filter((entry) => !beside(entry));
  data.filter((trace) => trace.colorbar).forEach((trace) => Object.assign(trace.colorbar, { x: 1.02, thickness: 10 }));
  return layout;
}

function draw(box) {
  const figure = JSON.parse(inColors(box.querySelector("script").textContent)), width = box.clientWidth;
  const config = { displaylogo: false, displayModeBar: width > 560 ? "hover" : false };
  box.drawn = width;
  return Plotly.react(box.target, figure.data, { ...fitted(figure, width), width }, config);
}

async function figures() {
  const boxes = [...document.querySelectorAll(".plot")];
  if (!boxes.length) return;
  try {
    await library();
  } catch (error) {
    for (const box of boxes) box.append(`No figure: ${error.message}.`);
    return;
  }
  for (const box of boxes) box.append((box.target = Object.assign(document.createElement("div"), { style: "height:100%" })));
  const near = new IntersectionObserver(
    (entries) => entries.filter((entry) => entry.isIntersecting && !entry.target.drawn).forEach((entry) => draw(entry.target)),
    { rootMargin: "600px" },
  );
  boxes.forEach((box) => near.observe(box));
  // a turned phone or a dragged window: Plotly's own answer comes late and keeps the layout of the old width
  const sized = new ResizeObserver((entries) => entries.map((entry) => entry.target).filter((box) => box.drawn && box.drawn !== box.clientWidth).forEach(draw));
  boxes.forEach((box) => sized.observe(box));
  darkness.addEventListener("change", () => boxes.filter((box) => box.drawn).forEach(draw));
  addEventListener("beforeprint", () => boxes.filter((box) => !box.drawn).forEach(draw));
}
figures();
