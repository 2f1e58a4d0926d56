// Requests of a page to its server, with the token that is in the address of the page.

const token = new URLSearchParams(location.search).get("token") ?? "";

// Return an address from which the page reads.
export function at(path, query = {}) {
  return `${path}?${new URLSearchParams({ ...query, token })}`;
}

// Send a value as JSON, and return the answer.
export function post(path, value, options = {}) {
  const headers = { "Content-Type": "application/json", Authorization: `Bearer ${token}` };
  return fetch(path, { method: "POST", headers, body: JSON.stringify(value), ...options });
}
