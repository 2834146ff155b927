"use strict";
// The engine is unpacked only when the first figure is to be zoomed, so that the page opens at once.
(() => {
  if (window.DecompressionStream === undefined) {
    return;
  }
  const read = (id) => {
    const packed = Uint8Array.from(atob(document.getElementById(id).textContent), (letter) => letter.charCodeAt(0));
    return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };
  let engine;
  const start = async () => {
    const script = document.createElement("script");
    script.textContent = await read("engine");
    document.head.append(script);
    window.Bokeh.set_log_level("error");
  };
  const isDark = window.matchMedia("(prefers-color-scheme: dark)");
  const onDark = JSON.parse(document.getElementById("dark-colours").textContent);
  const draw = async (key) => {
    engine ??= start();
    await engine;
    const text = await read(`${key}-data`);
    const content = JSON.parse(isDark.matches ? text.replace(/#[0-9a-f]{6}/g, (colour) => onDark[colour] ?? colour) : text);
    const roots = Object.fromEntries(content.roots.map((root, panel) => [root, `${key}-live-${panel}`]));
    await window.Bokeh.embed.embed_items({ [key]: content.document }, [{ docid: key, roots, root_ids: content.roots }]);
  };
  for (const button of document.querySelectorAll("button.zoom")) {
    const key = button.dataset.chart;
    const figure = document.getElementById(key);
    const live = figure.querySelector(".live");
    const still = figure.querySelector(".still");
    let drawn;
    const show = async () => {
      if (!live.hidden && drawn === undefined) {
        drawn = draw(key);
        await drawn;
        figure.dataset.drawn = "true";
      }
    };
    button.hidden = false;
    button.addEventListener("click", () => {
      live.hidden = !live.hidden;
      still.hidden = !live.hidden;
      button.setAttribute("aria-pressed", String(!live.hidden));
      show();
    });
    // The engine paints in fixed colours: on other paper it paints anew.
    isDark.addEventListener("change", () => {
      drawn = undefined;
      for (const place of live.querySelectorAll(".plot")) {
        place.replaceChildren();
      }
      show();
    });
  }
})();
