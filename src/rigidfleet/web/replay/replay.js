// A finished flight, read from the page itself.

import { Renderer } from "./gl.js";
import { Player, part, say } from "./player.js";
import { Recording, unpack } from "./recording.js";

async function main() {
  try {
    const info = JSON.parse(part("info").textContent);
    const unpacking = unpack(part("data").textContent, info.columns, info.count);
    const renderer = new Renderer(part("view")); // while the samples are inflated
    window.replay = new Player(new Recording(info, await unpacking, info.count), renderer);
  } catch (error) {
    say(`This flight cannot be shown: ${error.message}. It needs a browser of 2023 or later with WebGL 2 (hardware acceleration) switched on.`);
    throw error;
  }
}

main();
