/**
 * Ends being moved. They are drawn where they are wanted at once; the workbench is told one place after the other, and
 * when it has said so, its own word counts again.
 */

/** Shown until the slice with the edit is in: an answer may come before it. */
const LINGERS_MS = 400;

/** Edits under way, by match and side. */
export class Edits {
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

  /** @returns {number[][]} the ends of a match as they are to be shown */
  endsOf(pick, side) {
    return this.#shown.get(`${side} ${pick.id}`)?.ends ?? pick[side];
  }

  /** Show the ends there, without telling anyone. */
  show(id, side, ends) {
    this.#shown.set(`${side} ${id}`, { ends });
    this.#changed();
  }

  /** Show them where the workbench has them. */
  drop(id, side) {
    if (this.#queues.has(`${side} ${id}`)) return;
    if (this.#shown.delete(`${side} ${id}`)) this.#changed();
  }

  /** Show the ends there and tell the workbench; of several places in quick succession the newest is told. */
  commit(id, side, ends) {
    const key = `${side} ${id}`;
    this.show(id, side, ends);
    const busy = this.#queues.has(key);
    this.#queues.set(key, ends);
    if (!busy) this.#tell(id, side, key);
  }

  async #tell(id, side, key) {
    let sent;
    try {
      do {
        sent = this.#queues.get(key);
        await this.#send(id, side, sent);
      } while (this.#queues.get(key) !== sent);
    } catch {
      sent = null; // `send` has said why; the old place is shown again at once
    }
    this.#queues.delete(key);
    const mine = this.#shown.get(key);
    setTimeout(() => this.#shown.get(key) === mine && this.drop(id, side), sent ? LINGERS_MS : 0);
  }
}
