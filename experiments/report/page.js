"use strict";
// Choice of colours, and tables that sort by a column. Without scripts the page reads the same.
(() => {
  const root = document.documentElement;
  const choices = ["auto", "light", "dark"];
  const colours = document.createElement("button");
  colours.id = "colours";
  colours.type = "button";
  const choose = (name) => {
    if (name === "auto") delete root.dataset.colours;
    else root.dataset.colours = name;
    colours.textContent = `colours: ${name}`;
    colours.dataset.next = choices[(choices.indexOf(name) + 1) % choices.length];
    document.dispatchEvent(new Event("colours"));
  };
  colours.addEventListener("click", () => choose(colours.dataset.next));
  document.querySelector("header").prepend(colours);
  choose("auto");

  const words = new Intl.Collator("en", { numeric: true });
  // The first number of a cell such as "0.016 ±0.003", "5 of 6" or "<0.1"; NaN for words.
  const number = (text) => {
    const found = /^[<≤≥>]?\s*([-+−]?[\d,]*\.?\d+(?:e[-+]?\d+)?)/i.exec(text);
    return found ? Number(found[1].replace("−", "-").replaceAll(",", "")) : NaN;
  };
  const compare = (a, b, sign) => {
    // Cells without a value stay last whichever way the column is sorted.
    if (a.empty || b.empty) return a.empty - b.empty;
    if (a.numeric && b.numeric) return sign * (a.value - b.value);
    return sign * words.compare(a.text, b.text);
  };
  const sortable = (table) => {
    const body = table.tBodies[0];
    const rows = [...body.rows];
    const heads = [...table.tHead.rows[0].cells];
    const sort = (place, direction) => {
      heads.forEach((head, k) => {
        if (k === place && direction) head.setAttribute("aria-sort", direction);
        else head.removeAttribute("aria-sort");
      });
      table.classList.toggle("sorted", Boolean(direction));
      if (!direction) return body.append(...rows);
      const numeric = heads[place].classList.contains("n");
      const keyed = rows.map((row) => {
        const text = row.cells[place].firstChild?.textContent.trim() ?? "";
        const value = number(text);
        const told = numeric && !Number.isNaN(value);
        return { row, text, value, numeric: told, empty: text === "" || text === "–" };
      });
      keyed.sort((a, b) => compare(a, b, direction === "ascending" ? 1 : -1));
      body.append(...keyed.map((one) => one.row));
    };
    heads.forEach((head, place) => {
      const button = document.createElement("button");
      button.type = "button";
      button.className = "sort";
      button.title = "sort by this column";
      button.append(...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => {
        const next = { ascending: "descending", descending: null };
        const now = head.getAttribute("aria-sort");
        sort(place, now ? next[now] : "ascending");
      });
    });
  };
  document.querySelectorAll(".wide > table").forEach((table) => {
    if (table.tBodies[0].rows.length > 1) sortable(table);
  });
})();
