// A flight that is over, out of the page itself.

import { Player, part, say } from "./player.js";
import { Recording, unpack } from "./recording.js";

async function main() {
  try {
    const info = JSON.parse(part("info").textContent);
    const columns = await unpack(part("data").textContent, info.columns, info.count);
    window.replay = new Player(new Recording(info, columns, info.count));
  } catch (error) {
    say(`This flight cannot be shown: ${error.message}. It needs a browser of 2023 or later with WebGL 2 (hardware acceleration) switched on.`);
    throw error;
  }
}

main();
