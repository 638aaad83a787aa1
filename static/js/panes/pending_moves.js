/**
 * Moves of ends that the workbench has not confirmed yet. They are drawn at once; positions are sent one at a time, and
 * after the answer the workbench's own position is shown again.
 */

/** The position is shown this long after the answer, since the slice with the edit may follow it. */
const SHOWN_AFTER_MS = 400;

/** Unconfirmed moves, by match and side. */
export class PendingMoves {
  #shown = new Map();
  #queues = new Map();
  #send;
  #changed;

  /**
   * @param {(id: string, side: "scan" | "photo", ends: number[][]) => Promise<any>} send
   * @param {() => void} changed
   */
  constructor(send, changed) {
    this.#send = send;
    this.#changed = changed;
  }

  /** @returns {number[][]} the ends of a match to show */
  endsOf(pick, side) {
    return this.#shown.get(`${side} ${pick.id}`)?.ends ?? pick[side];
  }

  /** Show ends at a position without sending it. */
  show(id, side, ends) {
    this.#shown.set(`${side} ${id}`, { ends });
    this.#changed();
  }

  /** Show the workbench's position again, unless a move is being sent. */
  drop(id, side) {
    if (this.#queues.has(`${side} ${id}`)) return;
    if (this.#shown.delete(`${side} ${id}`)) this.#changed();
  }

  /** Show ends at a position and send it; of several positions in quick succession the newest is sent. */
  commit(id, side, ends) {
    const key = `${side} ${id}`;
    this.show(id, side, ends);
    const busy = this.#queues.has(key);
    this.#queues.set(key, ends);
    if (!busy) this.#transmit(id, side, key);
  }

  async #transmit(id, side, key) {
    let sent;
    try {
      do {
        sent = this.#queues.get(key);
        await this.#send(id, side, sent);
      } while (this.#queues.get(key) !== sent);
    } catch {
      sent = null; // `send` has reported why; the old position is shown again at once
    }
    this.#queues.delete(key);
    const mine = this.#shown.get(key);
    setTimeout(() => this.#shown.get(key) === mine && this.drop(id, side), sent ? SHOWN_AFTER_MS : 0);
  }
}
