// Controls of the page: native inputs with labels.

// Fills `box` with radio buttons; calls `chosen` with the index. Returns a function that chooses one.
export function radios(box, names, chosen) {
  const inputs = names.map((name, index) => {
    const input = Object.assign(document.createElement("input"), { type: "radio", name: box.id, checked: index === 0 });
    input.addEventListener("change", () => chosen(index));
    const label = document.createElement("label");
    label.append(input, Object.assign(document.createElement("span"), { textContent: name }));
    box.append(label);
    return input;
  });
  return (index) => {
    inputs[index].checked = true;
    chosen(index);
  };
}

// Fills `box` with one labelled slider; calls `moved` with its value. Returns a function that sets it without a call.
export function slider(box, name, [min, max, step], show, moved) {
  const input = Object.assign(document.createElement("input"), { type: "range", min, max, step, value: 0 });
  const output = document.createElement("output");
  const label = Object.assign(document.createElement("label"), { className: "slider" });
  label.append(Object.assign(document.createElement("span"), { textContent: name }), input, output);
  box.append(label);
  const set = (value) => {
    input.value = value;
    output.textContent = show(value);
  };
  input.addEventListener("input", () => {
    output.textContent = show(Number(input.value));
    moved(Number(input.value));
  });
  set(0);
  return set;
}

export function options(select, names) {
  select.replaceChildren(...names.map((name, value) => new Option(name, value)));
}
