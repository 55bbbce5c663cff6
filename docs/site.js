// Lines break between the words of inline code, not at the hyphens of an option; short code is not broken at all.
const SHORT = 20;
const LONG = 40;

function whole(text) {
  const span = document.createElement("span");
  span.className = "whole";
  span.textContent = text;
  return span;
}

for (const code of document.querySelectorAll(".md-typeset :not(pre, h1, h2, h3, h4, h5, h6) > code")) {
  if (code.children.length > 0) continue;
  const text = code.textContent;
  const words = text.length <= SHORT ? [text] : text.split(/(\s+)/);
  code.replaceChildren(...words.map((word) => (/^\s/.test(word) || word.length > LONG ? word : whole(word))));
}
