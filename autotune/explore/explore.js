"use strict";
// What the page does by itself, beside what the server sends.
const explore = (() => {
  const page = () => Bokeh.documents[0];
  const REST_MS = 300;
  const isDark = matchMedia("(prefers-color-scheme: dark)");

  // A slider holds the logarithm of its number: a screen reader gets the number and its unit, as the title has it.
  function labelSlider(root) {
    const title = root.querySelector(".bk-slider-title");
    const handle = root.querySelector("[role=slider]");
    const value = title && title.querySelector(".bk-slider-value");
    if (!handle || !value) return;
    const name = title.firstChild.textContent.replace(/:\s*$/, "");
    const unit = (name.match(/\[(.*)\]$/) || ["", ""])[1];
    const labels = { "aria-label": name.replace(/\s*\[.*\]$/, ""), "aria-valuetext": `${value.textContent} ${unit}`.trim() };
    for (const [key, text] of Object.entries(labels)) {
      if (handle.getAttribute(key) !== text) handle.setAttribute(key, text);
    }
  }

  function labelSliders() {
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
      new MutationObserver(() => labelSlider(root)).observe(root, watched);
      labelSlider(root);
    }
  }

  // What a slider's position stands for: `tags` say how, and within which ends.
  const spanOf = slider => slider.tags[0] || { logarithmic: false, low: slider.start, high: slider.end };
  const numberAt = slider => String(Number((spanOf(slider).logarithmic ? 10 ** slider.value : slider.value).toPrecision(6)));

  // A number that is typed moves the slider, and the slider changes the number; what is none is put back.
  function joinField(control) {
    const slider = page().get_model_by_name(control.dataset.control);
    const field = control.querySelector("input"), message = control.querySelector("p");
    const said = text => {
      message.textContent = text;
      field.setAttribute("aria-invalid", String(text !== ""));
    };
    const follow = () => {
      control.hidden = !slider.visible;
      if (control.hidden) return;
      field.setAttribute("aria-label", slider.title);
      field.value = numberAt(slider);
    };
    const take = () => {
      const text = field.value.trim(), { logarithmic, low, high } = spanOf(slider);
      const number = text === "" ? NaN : Number(text), isWithin = number >= low && number <= high;
      if (isWithin && text !== numberAt(slider)) slider.value = logarithmic ? Math.log10(number) : number;
      const ends = `${Number(low.toPrecision(6))} to ${Number(high.toPrecision(6))}`;
      said(isWithin ? "" : `${slider.title} must be a number from ${ends}; “${text}” was put back.`);
      follow();
    };
    const properties = slider.properties;
    properties.value.change.connect(() => {
      said("");
      follow();
    });
    for (const each of [properties.visible, properties.tags, properties.title]) each.change.connect(follow);
    field.addEventListener("change", take);
    field.addEventListener("keydown", event => {
      if (event.key !== "Escape") return;
      follow();
      said("");
    });
    follow();
  }

  // A click on a button of the table of kept designs; the count makes two of the same click two.
  let clicks = 0;
  function watchKept() {
    document.addEventListener("click", event => {
      const button = event.composedPath().find(each => each.dataset && each.dataset.kept);
      if (button) page().get_model_by_name("kept-click").said = `${button.dataset.kept} ${clicks += 1}`;
    });
  }

  // Canvases know no style sheet: all that is drawn takes its colours from the page's here.
  const FRAME = {
    soft: ["axis_label_text_color", "major_label_text_color", "title_text_color", "axis_line_color",
      "major_tick_line_color", "minor_tick_line_color"],
    grid: ["grid_line_color"],
    line: ["outline_line_color"],
  };
  // What is drawn in one colour, as it is on light paper.
  const INK = ["line_color", "fill_color", "text_color"];
  const drawnIn = new Map();

  function dress() {
    const onDark = JSON.parse(document.getElementById("dark-colours").textContent);
    const style = getComputedStyle(document.documentElement);
    const colour = name => style.getPropertyValue(`--${name}`).trim();
    const set = (model, values) => model.setv(values, { sync: false });
    const shown = light => (isDark.matches && onDark[light]) || light;
    for (const model of page().all_models) {
      for (const [name, keys] of Object.entries(FRAME)) {
        for (const key of keys) if (key in model && model[key] !== null) set(model, { [key]: colour(name) });
      }
      const lights = drawnIn.get(model) || {};
      drawnIn.set(model, lights);
      for (const key of INK) {
        const given = key in model ? model[key] : null, isPlain = typeof given === "string";
        lights[key] ||= isPlain ? given : given && given.value;
        if (lights[key] in onDark) set(model, { [key]: isPlain ? shown(lights[key]) : { value: shown(lights[key]) } });
      }
    }
    for (const item of document.querySelectorAll("li[style]")) {
      item.dataset.line ||= item.style.getPropertyValue("--line-colour").trim();
      item.style.setProperty("--line-colour", shown(item.dataset.line));
    }
    const ground = { background_fill_color: colour("paper") };
    set(page().get_model_by_name("ratios"), { text_color: colour("ink") });
    for (const name of ["ratios", "words-data-kept", "words-data-ending"]) set(page().get_model_by_name(name), ground);
    for (const place of document.querySelectorAll(".drawn")) set(page().get_model_by_name(place.id), ground);
    set(page().get_model_by_name("grounds"), { palette: [colour("unstable"), colour("missed")] });
  }

  // A legend names what is drawn, and nothing else.
  function watchLegends() {
    for (const item of document.querySelectorAll("li[data-source]")) {
      const source = page().get_model_by_name(item.dataset.source);
      const follow = () => {
        item.hidden = (source.data.xs || source.data.x).length === 0;
      };
      source.properties.data.change.connect(follow);
      follow();
    }
  }

  // What is in view is drawn first; the rest once the hand rests, or when it comes into view.
  const inView = new Set();
  const waiting = new Map();
  let rest = null;

  // Not sent to the server, where it comes from.
  const give = (name, values) => page().get_model_by_name(name).setv(values, { sync: false });

  function giveWaiting(key) {
    for (const [name, [place, values]] of [...waiting]) {
      if (key !== undefined && place !== key) continue;
      waiting.delete(name);
      give(name, values);
    }
  }

  // An array of the message is where it begins in `numbers`, and its shape.
  function unpack({ text, numbers }) {
    const { ndarray } = Bokeh.require("core/util/ndarray");
    const arrayAt = ([begin, shape]) => {
      const count = shape.reduce((product, length) => product * length, 1);
      const array = new Float64Array(numbers.buffer, numbers.byteOffset + 8 * begin, count);
      return shape.length > 1 ? ndarray(array, { dtype: "float64", shape }) : array;
    };
    return JSON.parse(text, (_key, value) => (value && value.numbers ? arrayAt(value.numbers) : value));
  }

  // Tasks of their own: the engine takes data in in microtasks, all of which are done when a message to ourselves comes.
  const channel = new MessageChannel();
  const tasks = [];
  channel.port1.onmessage = () => tasks.shift()();
  function soon(task) {
    tasks.push(task);
    channel.port2.postMessage(null);
  }

  // A figure is held until all of its data are there, and then drawn at once and not in the next frame. A new map comes
  // first, and the rest once the frame with it is done.
  function handOn(content) {
    const changes = Object.entries(unpack(content)).map(([name, values]) => {
      const [place] = page().get_model_by_name(name).tags;
      return { name, values, place: typeof place === "string" ? place : null };
    });
    const seen = new Set(changes.map(each => each.place).filter(place => inView.has(place)));
    const views = new Map([...seen].map(key => [key, Bokeh.index.get(page().get_model_by_name(key))]));
    for (const view of views.values()) view.pause();
    const givePart = isPart => {
      for (const { name, values, place } of changes.filter(each => isPart(each.place))) {
        if (place === null || seen.has(place)) give(name, values);
        else waiting.set(name, [place, { ...(waiting.get(name) || [place, {}])[1], ...values }]);
      }
    };
    const draw = key => {
      views.get(key).unpause(true);
      views.get(key).repaint();
    };
    const drawRest = () => {
      givePart(place => place !== "map");
      soon(() => [...seen].filter(key => key !== "map").forEach(draw));
    };
    if (seen.has("map") && changes.some(each => each.name === "data-map")) {
      givePart(place => place === "map");
      soon(() => {
        draw("map");
        requestAnimationFrame(() => soon(drawRest));
      });
    } else {
      givePart(place => place === "map");
      if (seen.has("map")) soon(() => draw("map"));
      drawRest();
    }
    clearTimeout(rest);
    rest = setTimeout(giveWaiting, REST_MS);
  }

  function watchView() {
    const watcher = new IntersectionObserver(seen => {
      for (const { target, isIntersecting } of seen) {
        if (isIntersecting) {
          inView.add(target.id);
          giveWaiting(target.id);
        } else inView.delete(target.id);
      }
    });
    document.querySelectorAll(".drawn").forEach(place => watcher.observe(place));
  }

  function begin() {
    labelSliders();
    document.querySelectorAll(".control").forEach(joinField);
    watchKept();
    watchView();
    watchLegends();
    dress();
    isDark.addEventListener("change", dress);
  }

  // Nothing is answered any more: no control may look as if it were, and none may differ from what is shown.
  function end() {
    giveWaiting();
    const answered = page().get_model_by_name("facts").tags[0] || {};
    for (const model of page().all_models) {
      if (model.name in answered) model.setv({ value: answered[model.name] }, { sync: false });
      if ("disabled" in model && ("value" in model || "label" in model)) model.setv({ disabled: true }, { sync: false });
    }
    for (const field of document.querySelectorAll(".control input")) field.disabled = true;
    const status = page().get_model_by_name("status");
    if (status.text.includes("busy")) {
      const text = '<p class="bad">The server ended before the save was reported: check whether the file is written.</p>';
      status.setv({ text }, { sync: false });
    }
    document.getElementById("ended").hidden = false;
  }

  return { begin, end, handOn };
})();
