// A click on a header sorts its table: numbers by value, the lines of one row stay together.
document.querySelectorAll("table").forEach((table) => {
  const body = table.tBodies[0];
  table.querySelectorAll("th").forEach((head, column) => head.addEventListener("click", () => {
    const up = head.getAttribute("aria-sort") !== "ascending";
    const groups = [];
    for (const row of body.rows) {
      if (row.cells[0].textContent.trim() || !groups.length) groups.push([]);
      groups.at(-1).push(row);
    }
    const text = (group) => group[0].cells[column].textContent.trim();
    const number = (group) => parseFloat(text(group).replace(/^[*_\[]+/, ""));
    groups.sort((a, b) => {
      const [x, y] = [number(a), number(b)];
      const order = isNaN(x) || isNaN(y) ? isNaN(x) - isNaN(y) || text(a).localeCompare(text(b)) : x - y;
      return up ? order : -order;
    });
    table.querySelectorAll("th").forEach((other) => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    body.append(...groups.flat());
  }));
});
