// Messages above the picture that stay until somebody closes them or does something else.

/** @param {HTMLElement} message */
export function hush(message) {
  message.replaceChildren();
  message.classList.remove("bad");
}

/** @param {HTMLElement} news in which a button[data-close] follows each message that can be closed */
export function prepareNews(news) {
  for (const close of news.querySelectorAll("[data-close]")) {
    close.addEventListener("click", () => hush(close.previousElementSibling));
  }
}
