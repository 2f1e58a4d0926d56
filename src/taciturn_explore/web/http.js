// The page on this machine: answers come from the server, and the address holds the setting.

import { mount } from "./explore.js";
import { mount as mountRecording } from "./recording.js";
import { at, post } from "./requests.js";

const client = Array.from(crypto.getRandomValues(new Uint32Array(4)), (one) => one.toString(36)).join(""); // also without https

const ENDED = "the program that serves this page has ended; start taciturn explore again, and open the address that it prints";

// Return the sentence of an error: that of the server, or that there is none.
function said(error) {
  return error instanceof TypeError ? ENDED : error.message; // a request without an answer is an error of this type
}

// Read lines of JSON from the answer to a request, and hand each to `take`, until the request is aborted.
async function read(answer, take) {
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    const lines = (rest + value).split("\n");
    rest = lines.pop();
    for (const line of lines) take(JSON.parse(line));
  }
}

const transport = {
  // Ask for the answers to a request; return a function that ends it.
  ask(request, take, ended) {
    const abort = new AbortController();
    post("answers", { client: client + (request.whose ?? ""), ...request }, { signal: abort.signal })
      .then(async (answer) => {
        if (!answer.ok) throw new Error(await answer.text());
        await read(answer, (one) => abort.signal.aborted || take(one));
        if (!abort.signal.aborted) ended(null);
      })
      .catch((error) => {
        if (!abort.signal.aborted) ended(said(error));
      });
    return () => abort.abort();
  },

  // Return the problem file of a setting.
  async file(text) {
    const answer = await post("file", { client, text }).catch((error) => { throw new Error(said(error)); });
    if (!answer.ok) throw new Error(await answer.text());
    return answer.text();
  },

  address: {
    read: () => location.hash.slice(1),
    write: (text) => history.replaceState(null, "", `#${text}`),
    link: () => location.href, // with the token, without which no browser may read the page
    opens: "it opens on this machine while this page is served; it has the token of the page, so keep it to yourself",
  },
};

async function begin() {
  const first = await (await fetch(at("begin"))).json();
  if (first.recording) return mountRecording(document.getElementById("explore"), first.recording);
  mount(document.getElementById("explore"), transport, transport.address.read() || first.text, first.problems, first.text);
  addEventListener("hashchange", () => location.reload());
}

begin();
