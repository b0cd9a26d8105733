"use strict";
(() => {
  const table = document.getElementById("flights");
  const body = table.tBodies[0];
  const heads = [...table.tHead.rows[0].cells];
  const rows = [...body.rows];
  const find = document.getElementById("find");
  const show = document.getElementById("show");

  const keyOf = (row, column) => row.cells[column].dataset.key ?? row.cells[column].textContent;

  function sortBy(column, descending) {
    const numeric = heads[column].classList.contains("number");
    const known = rows.filter((row) => keyOf(row, column) !== "");
    const unknown = rows.filter((row) => keyOf(row, column) === ""); // last, whichever way
    known.sort((a, b) => {
      const [x, y] = [keyOf(a, column), keyOf(b, column)];
      const order = numeric ? Number(x) - Number(y) : x.localeCompare(y, "en", { numeric: true });
      return descending ? -order : order;
    });
    body.append(...known, ...unknown);
    heads.forEach((head) => head.removeAttribute("aria-sort"));
    heads[column].setAttribute("aria-sort", descending ? "descending" : "ascending");
  }

  function filter() {
    const words = find.value.toLowerCase();
    let count = 0;
    for (const row of rows) {
      const fits = (!show.value || row.dataset.state === show.value) && row.textContent.toLowerCase().includes(words);
      row.hidden = !fits;
      count += fits;
    }
    document.getElementById("shown").textContent = count === rows.length ? "" : `${count} of ${rows.length}`;
  }

  heads.forEach((head, column) => {
    head.addEventListener("click", () => sortBy(column, head.getAttribute("aria-sort") === "ascending"));
  });
  find.addEventListener("input", filter);
  show.addEventListener("change", filter);
  filter();
})();
