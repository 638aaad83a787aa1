/** What the simplex has walked so far, kept small, and how it is scaled to be read. No DOM here. */

const MOST = 1200;
export const NAMES = ["Tx", "Ty", "Tz", "α", "β", "γ"];

/** Steps of one walk; every second one is forgotten when they become too many. */
export class Walk {
  steps = [];
  #every = 1;
  #seen = 0;
  #last = null;

  /** @param {{iteration: number, parameters: number[], cost: number}} event */
  take({ iteration, parameters, cost }) {
    if (this.#last && iteration < this.#last.iteration) this.clear();
    this.#last = { iteration, parameters, cost };
    if (this.#seen++ % this.#every === 0) this.steps.push(this.#last);
    if (this.steps.length > MOST) {
      this.steps = this.steps.filter((_, index) => index % 2 === 0);
      this.#every *= 2;
    }
  }

  clear() {
    this.steps = [];
    this.#every = 1;
    this.#seen = 0;
    this.#last = null;
  }

  /** @returns {{iteration: number, parameters: number[], cost: number}[]} with the newest one always at the end */
  get shown() {
    return this.#last && this.steps.at(-1) !== this.#last ? [...this.steps, this.#last] : this.steps;
  }
}

/**
 * Six curves that share an axis though metres and radians do not: each moves about its last value, and lengths and
 * angles have a scale each.
 * @param {{parameters: number[]}[]} steps
 * @returns {{curves: number[][], reach: number[]}} values within [-1, 1]; what 1 stands for, in m and in rad
 */
export const scaledCurves = (steps) => {
  const last = steps.at(-1)?.parameters ?? [0, 0, 0, 0, 0, 0];
  const offsets = NAMES.map((_, index) => steps.map(({ parameters }) => parameters[index] - last[index]));
  const largest = (from) => offsets.slice(from, from + 3).flat().reduce(
    (most, value) => Math.max(most, Math.abs(value)),
    0,
  );
  const reach = [largest(0), largest(3)];
  const curves = offsets.map((curve, index) => curve.map((value) => value / (reach[index < 3 ? 0 : 1] || 1)));
  return { curves, reach };
};

/** @returns {number[]} log10 of the costs; what is not positive counts as the smallest that is */
export const logCosts = (steps) => {
  const positive = steps.map(({ cost }) => cost).filter((cost) => cost > 0);
  const least = positive.length ? Math.min(...positive) : 1;
  return steps.map(({ cost }) => Math.log10(cost > 0 ? cost : least));
};
