// Unpacks what the page carries (gzip in base64), names its modules in an import map, and starts viewer/main.js.

async function unpacked(id) {
  const bytes = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip")));
}

async function start() {
  const sources = await (await unpacked("packed-modules")).json();
  const imports = {};
  for (const [name, source] of Object.entries(sources)) {
    imports[name] = "data:text/javascript;charset=utf-8," + encodeURIComponent(source);
  }
  const map = document.createElement("script");
  map.type = "importmap";
  map.textContent = JSON.stringify({ imports });
  document.head.append(map);
  const { main } = await import("viewer/main.js");
  const avatar = await (await unpacked("packed-avatar")).arrayBuffer();
  const [recording, levels] = await Promise.all(
    ["packed-recording", "packed-levels"].map(async (id) => (await unpacked(id)).json()),
  );
  await main(avatar, recording, levels);
}

start().catch((error) => {
  console.error(error);
  document.getElementById("message").textContent = `This browser cannot show the avatar: ${error.message}`;
});
