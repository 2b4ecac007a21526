// Messages above the picture that stay until somebody closes them or does something else.

/** @param {HTMLElement} message */
export function closeBanner(message) {
  message.replaceChildren();
  message.classList.remove("bad");
}

/** @param {HTMLElement} news in which a button[data-close] follows each message that can be closed */
export function prepareBanners(news) {
  for (const close of news.querySelectorAll("[data-close]")) {
    close.addEventListener("click", () => closeBanner(close.previousElementSibling));
  }
}
