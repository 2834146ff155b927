"use strict";
// What the page does by itself, beside what the server sends.
const explore = (() => {
  const page = () => Bokeh.documents[0];

  // A slider stands on the logarithm of its number: a screen reader is told the number and its unit, as the title has it.
  function tellSlider(root) {
    const title = root.querySelector(".bk-slider-title");
    const handle = root.querySelector("[role=slider]");
    const value = title && title.querySelector(".bk-slider-value");
    if (!handle || !value) return;
    const name = title.firstChild.textContent.replace(/:\s*$/, "");
    const unit = (name.match(/\[(.*)\]$/) || ["", ""])[1];
    const told = { "aria-label": name.replace(/\s*\[.*\]$/, ""), "aria-valuetext": `${value.textContent} ${unit}`.trim() };
    for (const [key, text] of Object.entries(told)) {
      if (handle.getAttribute(key) !== text) handle.setAttribute(key, text);
    }
  }

  function tellSliders() {
    const roots = [];
    const walk = node => {
      if (node.shadowRoot) {
        if (node.shadowRoot.querySelector("[role=slider]")) roots.push(node.shadowRoot);
        [...node.shadowRoot.children].forEach(walk);
      }
      [...node.children].forEach(walk);
    };
    walk(document.querySelector(".hand"));
    for (const root of roots) {
      const watched = { subtree: true, childList: true, attributeFilter: ["aria-valuetext"] };
      new MutationObserver(() => tellSlider(root)).observe(root, watched);
      tellSlider(root);
    }
  }

  // Canvases know no style sheet: what is no plain text or line of a figure's frame takes its colours here.
  function dress() {
    const style = getComputedStyle(document.documentElement);
    const colour = name => style.getPropertyValue(`--${name}`).trim();
    const set = (name, values) => page().get_model_by_name(name).setv(values, { sync: false });
    set("told", { text_color: colour("ink"), background_fill_color: colour("paper") });
    set("grounds", { palette: [colour("unstable"), colour("missed")] });
    for (const place of document.querySelectorAll(".drawn")) set(place.id, { outline_line_color: colour("line") });
  }

  function begin() {
    tellSliders();
    dress();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", dress);
  }

  // Nothing is answered any more: no control may look as if it were, and none may differ from what is shown.
  function end() {
    const answered = page().get_model_by_name("facts").tags[0] || {};
    for (const model of page().all_models) {
      if (model.name in answered) model.setv({ value: answered[model.name] }, { sync: false });
      if ("disabled" in model && ("value" in model || "label" in model)) model.setv({ disabled: true }, { sync: false });
    }
    document.getElementById("ended").hidden = false;
  }

  return { begin, end };
})();
