// Renders the formulas that sphinx.ext.mathjax writes as \(...\) and \[...\], with KaTeX.
if (typeof katex !== "undefined") {
  for (const element of document.querySelectorAll(".math")) {
    const source = element.textContent.trim();
    katex.render(source.slice(2, -2), element, {
      displayMode: source.startsWith("\\["),
      throwOnError: false,
    });
  }
}
