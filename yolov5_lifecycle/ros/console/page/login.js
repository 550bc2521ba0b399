/** Sends the token; the cookie of the answer opens the page. */

const UNKNOWN = "This cannot be a token, or the console has ended.";

async function refusal(token) {
  try {
    const headers = { Authorization: `Bearer ${token}` };
    const reply = await fetch("/login", { method: "POST", headers });
    return reply.ok ? "" : await reply.text();
  } catch {
    return UNKNOWN;
  }
}

document.querySelector("form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const refused = document.getElementById("refused");
  refused.textContent = await refusal(document.getElementById("token").value.trim());
  if (refused.textContent === "") {
    location.assign("/");
  }
});
