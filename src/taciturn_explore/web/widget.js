// The page in a cell of a notebook: its transport are the messages of the widget, and its address is a trait.

import { mount } from "./explore.js";

export function render({ model, el }) {
  const open = new Map();
  let last = 0;
  const hear = (message) => {
    const mine = open.get(message.id);
    if (!mine) return;
    if (message.answer) mine.take(message.answer);
    else {
      open.delete(message.id);
      mine.ended(message.error ?? null, message.result);
    }
  };
  model.on("msg:custom", hear);
  const send = (content, take, ended) => {
    const id = `${Math.random().toString(36).slice(2)}-${++last}`;
    open.set(id, { take, ended });
    model.send({ id, ...content });
    return () => {
      open.delete(id);
      model.send({ id, end: true });
    };
  };
  const transport = {
    ask: (request, take, ended) => send({ request }, take, ended),
    file: (text) => new Promise((resolve, reject) => send({ file: text }, () => {}, (error, result) => (error ? reject(new Error(error)) : resolve(result)))),
    address: {
      read: () => model.get("setting"),
      write(text) {
        if (model.get("setting") === text) return;
        model.set("setting", text);
        model.save_changes();
      },
      link: () => model.get("setting"),
      opens: "it is the setting of a widget: widget.setting = \"…\"",
    },
  };
  const host = document.createElement("div"), style = document.createElement("style");
  style.textContent = model.get("styles");
  el.attachShadow({ mode: "open" }).append(style, host); // the styles of the page and those of the notebook stay apart
  const page = mount(host, transport, model.get("setting"));
  const changed = () => page.show(model.get("setting"));
  model.on("change:setting", changed);
  return () => {
    model.off("msg:custom", hear);
    model.off("change:setting", changed);
    for (const id of open.keys()) model.send({ id, end: true });
  };
}
