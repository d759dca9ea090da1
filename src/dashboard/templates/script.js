"use strict";
(() => {
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const make = (tag, text, parent) => {
    const element = document.createElement(tag);
    if (text !== undefined) element.textContent = text;
    if (parent) parent.append(element);
    return element;
  };

  // Sorting: the button of a column head; a second press turns the order around. Empty cells stay at the end.
  const sort = (head) => {
    const table = head.closest("table"), column = head.cellIndex, sign = head.ariaSort === "descending" ? -1 : 1;
    const value = (row) => row.cells[column]?.dataset.value ?? row.cells[column]?.textContent.trim() ?? "";
    for (const body of table.tBodies) {
      const rows = [...body.rows].map((row) => [value(row), row]);
      const numeric = rows.every(([text]) => text === "" || !Number.isNaN(Number(text)));
      rows.sort(([a], [b]) => {
        if (a === "" || b === "") return (a === "") - (b === "");
        return sign * (numeric ? a - b : a.localeCompare(b, undefined, { numeric: true }));
      });
      body.append(...rows.map(([, row]) => row));
    }
  };
  document.addEventListener("click", (event) => {
    const head = event.target.closest("th[aria-sort]");
    if (!head || !event.target.closest("button")) return;
    const first = "number" in head.dataset ? "descending" : "ascending";
    const turned = head.ariaSort === "descending" ? "ascending" : "descending";
    const order = head.ariaSort === "none" ? first : turned;
    for (const other of head.parentElement.cells) if (other.ariaSort) other.ariaSort = "none";
    head.ariaSort = order;
    sort(head);
  });

  // The end of a log is what one wants to see.
  const toEnd = (root) => { for (const text of all("pre.tail", root)) text.scrollTop = text.scrollHeight; };
  document.addEventListener("toggle", (event) => toEnd(event.target), true);

  // Filters: rows of a table, or lines of a text, that hold every word.
  const texts = new WeakMap();
  const filter = (input) => {
    const target = document.getElementById(input.dataset.filter);
    if (!target) return;
    const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
    const fits = (text) => words.every((word) => text.toLowerCase().includes(word));
    if (target.tagName === "PRE") {
      if (!texts.has(target)) texts.set(target, target.textContent);
      target.textContent = texts.get(target).split("\n").filter(fits).join("\n") || "no such line";
    } else {
      for (const row of all("tbody tr", target)) row.hidden = !fits(row.textContent);
    }
  };
  document.addEventListener("input", (event) => {
    if (event.target.dataset.filter) filter(event.target);
  });
  // The exported file holds every page; one is shown at a time, the first one before the others have been read.
  const root = document.documentElement, exported = "exported" in root.dataset;
  const show = (moved) => {
    const sections = all("main > .page"), target = document.getElementById(decodeURIComponent(location.hash.slice(1)));
    const section = target?.closest(".page") ?? sections[0];
    for (const one of sections) one.classList.toggle("shown", one === section);
    root.classList.add("ready");
    document.title = section.dataset.title;
    if (target && target !== section) target.scrollIntoView();
    else if (moved) window.scrollTo(0, 0);
    toEnd(section);
    if (moved) section.querySelector("h1")?.focus({ preventScroll: true });
  };
  if (exported) {
    root.classList.add("one-page");
    window.addEventListener("hashchange", () => show(true));
  }

  // Comparing two runs of the exported file: from what their sections say.
  const values = (section, selector) => new Map(all(selector, section).map((row) => [row.dataset.key, row]));
  const table = (parent, titles, rows) => {
    const box = make("div", undefined, parent), result = make("table", undefined, box);
    box.className = "scroll";
    const head = make("tr", undefined, make("thead", undefined, result));
    for (const [place, title] of titles.entries()) make("th", title, head).className = place ? "" : "text";
    const body = make("tbody", undefined, result);
    for (const row of rows) {
      const line = make("tr", undefined, body);
      row.forEach((text, place) => { make(place ? "td" : "th", text, line); });
    }
  };
  const compare = () => {
    const choices = all("#compare select");
    const [a, b] = choices.map((choice) => document.getElementById(choice.value));
    const out = document.getElementById("compared");
    out.replaceChildren();
    if (!a || !b) return;
    const names = ["left", "right"];
    const metrics = [a, b].map((section) => values(section, "tr[data-metric]"));
    make("h2", "Metrics", out);
    const columns = make("div", undefined, out), groups = new Map();
    columns.className = "columns";
    for (const [key, row] of metrics[0]) {
      const other = metrics[1].get(key), group = row.closest("table").tHead.rows[0].cells[0].textContent;
      if (!other) continue;
      const difference = row.dataset.metric - other.dataset.metric;
      const digits = (row.cells[1].textContent.split(".")[1] ?? "").length;
      const change = (difference >= 0 ? "+" : "\u2212") + Math.abs(difference).toFixed(digits);
      if (!groups.has(group)) groups.set(group, []);
      groups.get(group).push([row.cells[0].textContent, row.cells[1].textContent, other.cells[1].textContent, change]);
    }
    for (const [group, rows] of groups) table(columns, [group, ...names, "difference"], rows);
    make("h2", "Configuration, where it differs", out);
    const configs = [a, b].map((section) => {
      const lines = (section.querySelector("pre.config")?.textContent ?? "").split("\n").filter(Boolean);
      return new Map(lines.map((line) => [line.split(" = ", 1)[0], line.slice(line.indexOf(" = ") + 3)]));
    });
    const keys = [...new Set([...configs[0].keys(), ...configs[1].keys()])];
    const different = keys.filter((key) => configs[0].get(key) !== configs[1].get(key));
    const of = (config, key) => config.get(key) ?? "\u2013";
    if (different.length) table(out, ["key", ...names], different.map((key) => [key, ...configs.map((one) => of(one, key))]));
    else make("p", "The same.", out);
    make("h2", "Learning curves and figures", out);
    const figures = make("div", undefined, out);
    figures.className = "pair";
    for (const section of [a, b]) {
      const column = make("div", undefined, figures);
      for (const figure of all(".chart", section)) column.append(figure.cloneNode(true));
    }
    make("h2", "Pictures", out);
    const pictures = [a, b].map((section) => values(section, "figure.picture"));
    const shared = [...pictures[0].keys()].filter((key) => pictures[1].has(key));
    if (!shared.length) make("p", "No picture of the same frame is in this file for both runs.", out);
    for (const key of shared) {
      const pair = make("div", undefined, out);
      pair.className = "pair";
      pair.append(...pictures.map((of) => of.get(key).cloneNode(true)));
    }
  };
  document.addEventListener("change", (event) => {
    if (event.target.closest("#compare")) compare();
  });
  document.addEventListener("click", (event) => {
    const run = event.target.closest("a[data-compare]")?.dataset.compare, choice = document.querySelector("#compare select");
    if (run && choice) { choice.value = run; compare(); }
  });

  // Live: ask whether anything changed, often while something trains, and change only what differs on the page.
  const key = (node) => (node.nodeType === 1 ? node.id || node.dataset.key || null : null);
  const patch = (old, fresh) => {
    if (old.isEqualNode(fresh)) return;
    for (const { name } of [...old.attributes]) if (!fresh.hasAttribute(name) && !["open", "hidden"].includes(name)) old.removeAttribute(name);
    for (const { name, value } of [...fresh.attributes]) {
      if (!["open", "hidden", "aria-sort"].includes(name) && old.getAttribute(name) !== value) old.setAttribute(name, value);
    }
    if (["INPUT", "SELECT"].includes(old.tagName)) return;
    texts.delete(old);
    const keyed = new Map([...old.childNodes].filter(key).map((node) => [key(node), node]));
    let place = old.firstChild;
    for (const child of [...fresh.childNodes]) {
      let match = key(child) ? keyed.get(key(child)) : place;
      while (!key(child) && match && key(match)) match = match.nextSibling;
      if (match && match.nodeName === child.nodeName && (child.nodeType !== 1 || key(match) === key(child))) {
        if (match !== place) old.insertBefore(match, place);
        else place = place.nextSibling;
        if (child.nodeType === 1) patch(match, child);
        else if (match.data !== child.data) match.data = child.data;
      } else {
        old.insertBefore(document.importNode(child, true), place);
      }
    }
    while (place) { const next = place.nextSibling; place.remove(); place = next; }
  };
  const look = async () => {
    const body = document.body, status = document.getElementById("status");
    let pause = 0;
    if (!document.hidden && body.dataset.mark) {
      try {
        const mark = await (await fetch("/mark")).text();
        if (mark !== body.dataset.mark) {
          const answer = await fetch(location.pathname + location.search);
          if (answer.ok) {
            const fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
            const focused = document.activeElement;
            const followed = all("pre.tail").filter((text) => text.scrollTop + text.clientHeight > text.scrollHeight - 4);
            patch(document.getElementById("content"), fresh.getElementById("content"));
            for (const text of followed) text.scrollTop = text.scrollHeight;
            if (focused !== document.activeElement && focused.isConnected) focused.focus({ preventScroll: true });
            Object.assign(body.dataset, fresh.body.dataset);
            status.textContent = fresh.getElementById("status").textContent;
            for (const head of all("th[aria-sort]:not([aria-sort=none])")) sort(head);
            for (const element of all("[data-script]")) element.hidden = false;
            for (const input of all("input[data-filter]")) if (input.value) filter(input);
          }
        }
      } catch {
        status.textContent = "The dashboard's server does not answer; this is what it said last.";
        pause = 30000;
      }
    }
    setTimeout(look, pause || (body.dataset.live === "true" ? 3000 : 30000));
  };

  document.addEventListener("DOMContentLoaded", () => {
    for (const element of all("[data-script]")) element.hidden = false;
    toEnd(document);
    if (exported) show(false);
    else setTimeout(look, 3000);
  });
})();
