/* Sends the sliders' values to the server that this page is from, and shows the plan that it answers. */
window.explorer = (() => {
  const form = document.getElementById("sliders");
  const feedback = document.getElementById("feedback");
  const state = document.getElementById("state");
  const save = document.getElementById("save");
  const cost = document.getElementById("cost");
  let answer = JSON.parse(document.getElementById("report-data").textContent).answer;

  // ---- sliders: a range for the hand beside a number for the rest --------------------------------

  const rows = [...form.querySelectorAll("[data-key]")].map((number) => {
    const label = number.closest("label");
    const range = label.querySelector("[type=range]");
    const [low, high, given] = [number.min, number.max, number.value].map(Number);
    const log = range.dataset.log !== undefined;
    const decimals = Math.max(0, Math.ceil(-Math.log10((high - low) / 500)));
    const valueAt = (share) => (log
      ? Number((low * (high / low) ** share).toPrecision(2))
      : Number((low + share * (high - low)).toFixed(decimals)));
    const shareOf = (value) => (log ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low));
    const place = () => { range.value = String(1000 * shareOf(Number(number.value))); };
    range.addEventListener("input", () => {
      number.value = String(Math.min(high, Math.max(low, valueAt(Number(range.value) / 1000))));
    });
    number.addEventListener("input", place);
    number.value = String(given);
    const row = { key: number.dataset.key, number, range, given, label, place };
    place();
    return row;
  });
  const ofNavigation = rows.filter(({ key }) => key.startsWith("navigation."));
  const feedbackGiven = feedback.checked;

  /* Of what is not as in the scenario. */
  function values() {
    const found = {};
    if (feedback.checked !== feedbackGiven) found["policy.kind"] = feedback.checked ? "feedback" : "open";
    for (const { key, number, given } of rows) {
      if (!number.disabled && Number(number.value) !== given) found[key] = Number(number.value);
    }
    return found;
  }

  function marked() {
    for (const { number, range } of ofNavigation) number.disabled = range.disabled = !feedback.checked;
    for (const { number, label, given } of rows) {
      label.firstElementChild.classList.toggle("changed", !number.disabled && Number(number.value) !== given);
    }
  }

  // ---- what the server answers -------------------------------------------------------------------

  const asks = () => JSON.stringify(values());
  let shown = asks(), busy = null, quiet = 0;

  /* Whether the plan that is drawn is that of the sliders, and verified. */
  function say(kind, text, reason = "") {
    const current = kind === "planned" || kind === "judged";
    state.dataset.state = kind;
    state.textContent = text;
    document.getElementById("reason").textContent = reason;
    document.body.classList.toggle("stale", !current);
    document.body.classList.toggle("pending", kind !== "judged");
    save.disabled = !current;
    cost.textContent = current ? answer.cost : "";
    cost.classList.toggle("bad", !answer.converged);
  }

  const refuse = (reason) => say("refused", "no plan", `${reason}. What is drawn below is not of these values.`);

  async function ask(path, body) {
    const got = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body });
    if (!got.ok) throw new Error(await got.text());
    return got.json();
  }

  const lost = (error) => refuse(`No answer from scp-recon explore: ${error.message}; is it still running?`);

  function told() {
    document.getElementById("verdict").innerHTML = answer.verdict;
    for (const { key, label } of rows) label.querySelector("small").textContent = answer.legal[key] || "";
  }

  /* The plan of the last values that were chosen: those between, while it was busy, are passed over. */
  async function plan() {
    await report.first;
    while (form.checkValidity() && asks() !== shown) {
      const [body, begun] = [asks(), performance.now()];
      const got = await ask("/plan", body);
      if (asks() !== body) continue;
      if (got.refused) {
        refuse(got.refused);
        return;
      }
      [answer, shown] = [got, null];
      await report.replace(got.drawn);
      shown = body;
      answer.effort += `, on the page after ${((performance.now() - begun) / 1000).toFixed(2)} s`;
      if (asks() !== shown) continue;
      told();
      say("planned", `${answer.effort}; verifying`);
      judgeLater();
    }
  }

  async function judge() {
    const body = shown;
    const got = await ask("/verdict", body);
    if (asks() !== body || shown !== body) return;
    answer.verdict = got.verdict;
    told();
    say("judged", answer.effort);
  }

  function judgeLater() {
    clearTimeout(quiet);
    quiet = setTimeout(() => judge().catch(lost), 300);
  }

  function chosen() {
    marked();
    clearTimeout(quiet);
    const wrong = rows.find(({ number }) => !number.disabled && !number.validity.valid);
    if (wrong) {
      const { label, number } = wrong;
      refuse(`${label.firstElementChild.textContent}: must be a number from ${number.min} to ${number.max}`);
    } else if (asks() === shown) {
      say("planned", `${answer.effort}; verifying`);
      judgeLater();
    } else {
      say("planning", "planning");
      busy = busy || plan().catch(lost).finally(() => { busy = null; });
    }
  }

  // ---- controls ----------------------------------------------------------------------------------

  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("input", chosen);
  document.getElementById("reset").addEventListener("click", () => {
    feedback.checked = feedbackGiven;
    for (const { number, given, place } of rows) { number.value = String(given); place(); }
    chosen();
  });
  save.addEventListener("click", () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([answer.toml], { type: "application/toml" }));
    link.download = `${document.querySelector("h1").textContent}.toml`;
    link.click();
    URL.revokeObjectURL(link.href);
  });

  marked();
  told();
  say("planned", `${answer.effort}; verifying`);
  report.first.then(judgeLater);
  return { values, state: () => state.dataset.state };
})();
