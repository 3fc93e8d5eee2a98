"use strict";
// Draws the charts of a page. The library and the charts are compressed; what unpacks them is the browser's own.
async function unpacked(id) {
  const text = atob(document.getElementById(id).textContent.trim());
  const bytes = Uint8Array.from(text, letter => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}
function wrapped(text, most) {
  const lines = [""];
  for (const word of text.split(" "))
    if (lines.at(-1) && lines.at(-1).length + word.length >= most) lines.push(word);
    else lines.push(`${lines.pop()} ${word}`.trim());
  return lines.join("\n");
}
// Columns of names that fit: each as wide as its longest name, at 7 pixels a letter and 30 for the line before it.
function fitting(names, room) {
  for (let n = Math.min(6, names.length); n > 1; n--) {
    const wide = Array.from({ length: n }, (_, j) => Math.max(...names.filter((_, i) => i % n === j).map(s => s.length)));
    if (wide.reduce((sum, letters) => sum + 7 * letters + 44, 0) <= room) return n;
  }
  return 1;
}
// On a narrow screen panels stand under each other, and the names above them in as many columns as there is room for.
function fitted(chart, width) {
  const children = chart.doc.roots[0].attributes.children;
  if (width < 600) children.forEach((child, number) => child.splice(1, 2, number, 0));
  const columns = 1 + Math.max(...children.map(child => child[2]));
  const narrow = (node, plot) => {
    if (node === null || typeof node !== "object") return;
    if (node.name === "Legend" && node.attributes) {
      const names = node.attributes.items.map(item => item.attributes.label.value);
      node.attributes.ncols = fitting(names, width / columns - 60);
      plot.height += 30 * (Math.ceil(names.length / node.attributes.ncols) - 1);
    }
    if (node.name === "Title" && node.attributes && node.attributes.text)
      node.attributes.text = wrapped(node.attributes.text, Math.floor((width / columns - 130) / 7));
    Object.values(node).forEach(one => narrow(one, plot));
  };
  children.forEach(child => narrow(child[0], child[0].attributes));
}
async function draw() {
  const script = document.createElement("script");
  script.textContent = new TextDecoder().decode(await unpacked("library"));
  document.head.append(script);
  const charts = JSON.parse(new TextDecoder().decode(await unpacked("charts")));
  for (const [id, chart] of Object.entries(charts)) {
    fitted(chart, document.getElementById(id).clientWidth);
    await Bokeh.embed.embed_item(chart, id);
    const named = Bokeh.documents.at(-1).roots()[0].children.flatMap(([plot]) => plot.renderers).filter(r => r.name);
    // Curves of one name vanish together in all panels. (Bokeh's own links are compiled in the browser, which the
    // page's security policy forbids.)
    for (const one of named)
      one.properties.visible.change.connect(() => {
        for (const other of named) if (other.name === one.name) other.visible = one.visible;
      });
  }
}
draw().then(() => document.dispatchEvent(new Event("drawn"))).catch(error => {
  for (const chart of document.querySelectorAll(".chart"))
    if (!chart.shadowRoot && !chart.childElementCount) chart.textContent = "This plot could not be drawn here: " + error;
  throw error;
});
