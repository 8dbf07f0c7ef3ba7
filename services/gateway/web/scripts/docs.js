/** The description of the API, to read and to try: Swagger UI on this gateway's OpenAPI. */

const KEY = "pointslam.key"; // of the console, in this tab

const dark = matchMedia("(prefers-color-scheme: dark)");
const followColours = () => document.documentElement.classList.toggle("dark-mode", dark.matches);
dark.addEventListener("change", followColours);
followColours();

window.ui = window.SwaggerUIBundle({
  url: "/openapi.json",
  dom_id: "#api",
  deepLinking: true,
  validatorUrl: null,
  onComplete() {
    const key = sessionStorage.getItem(KEY);
    if (key) window.ui.preauthorizeApiKey("key", key);
    document.body.dataset.ready = "true";
  },
});
