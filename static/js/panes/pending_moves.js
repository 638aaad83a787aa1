/**
 * Moves of ends that the workbench has not confirmed yet. They are drawn at once; positions are sent one at a time, and
 * after the answer the workbench's own position is shown again.
 */

/**
 * @typedef {import("./picking.js").Side} Side
 * @typedef {import("../net/store.js").Pick} Pick
 */

/** The position is shown this long after the answer, since the slice with the edit may follow it. */
const SHOWN_AFTER_MS = 400;

/** Unconfirmed moves, by match and side. */
export class PendingMoves {
  /** @type {Map<string, {ends: number[][]}>} */
  #shown = new Map();
  /** @type {Map<string, number[][]>} */
  #queues = new Map();
  #send;
  #photo;
  #changed;

  /**
   * @param {(photo: string, id: string, side: "scan" | "photo", ends: number[][]) => Promise<any>} send
   * @param {() => string | null} photo id of the shown photograph: matches of others may have the same ids
   * @param {() => void} changed
   */
  constructor(send, photo, changed) {
    this.#send = send;
    this.#photo = photo;
    this.#changed = changed;
  }

  /** @param {string} id @param {Side} side */
  #key(id, side) {
    return `${this.#photo()} ${side} ${id}`;
  }

  /** @param {Pick} pick @param {Side} side @returns {number[][]} the ends of a match to show */
  endsOf(pick, side) {
    return this.#shown.get(this.#key(pick.id, side))?.ends ?? pick[side];
  }

  /** Show ends at a position without sending it. @param {string} id @param {Side} side @param {number[][]} ends */
  show(id, side, ends) {
    this.#shown.set(this.#key(id, side), { ends });
    this.#changed();
  }

  /** Show the workbench's position again, unless a move is being sent. @param {string} id @param {Side} side */
  drop(id, side) {
    this.#forget(this.#key(id, side));
  }

  /** Forget positions that were never sent: another photograph is shown. */
  dropUnsent() {
    for (const key of [...this.#shown.keys()]) this.#forget(key);
  }

  /** @param {string} key */
  #forget(key) {
    if (this.#queues.has(key)) return;
    if (this.#shown.delete(key)) this.#changed();
  }

  /**
   * Show ends at a position and send it; of several positions in quick succession the newest is sent.
   * @param {string} id
   * @param {Side} side
   * @param {number[][]} ends
   */
  commit(id, side, ends) {
    const photo = this.#photo();
    if (photo === null) return; // matches are of a photograph
    const key = this.#key(id, side);
    this.show(id, side, ends);
    const busy = this.#queues.has(key);
    this.#queues.set(key, ends);
    if (!busy) this.#transmit(photo, id, side, key);
  }

  /** @param {string} photo @param {string} id @param {Side} side @param {string} key */
  async #transmit(photo, id, side, key) {
    let sent = this.#queues.get(key);
    try {
      while (sent) {
        await this.#send(photo, id, side, sent);
        const next = this.#queues.get(key);
        if (next === sent) break;
        sent = next;
      }
    } catch {
      sent = undefined; // `send` has reported why; the old position is shown again at once
    }
    this.#queues.delete(key);
    const mine = this.#shown.get(key);
    setTimeout(() => this.#shown.get(key) === mine && this.#forget(key), sent ? SHOWN_AFTER_MS : 0);
  }
}
