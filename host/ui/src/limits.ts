// Alarm limits in a trend: a line where the limit is in view, its name at the edge where it is not. Grey until its alarm stands.

import type uPlot from "uplot";
import type { Limit } from "./alarms";
import { value } from "./format";
import { colour } from "./theme";

/** A limit this near to the curves is brought into view, in heights of what they fill. */
const NEAR = 1.5;

/** The range of the curves, and of the limits that are near; `least` is the height that quiet curves are given. */
export function with_limits(limits: Limit[], least: number, low: number | null, high: number | null): [number | null, number | null] {
  if (low === null || high === null) return [low, high];
  const reach = NEAR * Math.max(high - low, least);
  const above = limits.map((limit) => limit.at).filter((at) => at > high && at - high <= reach);
  const below = limits.map((limit) => limit.at).filter((at) => at < low && low - at <= reach);
  return [Math.min(low, ...below), Math.max(high, ...above)];
}

export function draw_limits(u: uPlot, limits: Limit[], span: number): void {
  if (limits.length === 0) return;
  const context = u.ctx;
  const dpr = devicePixelRatio;
  const { left, top, width, height } = u.bbox;
  const shade = { high: colour("urgent"), medium: colour("warn"), low: colour("low") };
  const [muted, ground] = [colour("muted"), colour("panel")];
  context.save();
  context.font = `${11 * dpr}px system-ui, sans-serif`;
  context.textBaseline = "middle";
  // Those beyond the edge are named there, the nearest first.
  const edges = { above: 0, below: 0 };
  for (const limit of [...limits].sort((a, b) => Number(a.on) - Number(b.on))) {
    const y = u.valToPos(limit.at, "y", true);
    const words = `${limit.name} ${value(limit.at, span)}`;
    context.fillStyle = limit.on ? shade[limit.priority] : muted;
    context.strokeStyle = context.fillStyle;
    context.globalAlpha = limit.on ? 1 : 0.75;
    const inside = y >= top && y <= top + height;
    if (inside) {
      context.lineWidth = (limit.on ? 2 : 1) * dpr;
      context.setLineDash([2 * dpr, 3 * dpr]);
      context.beginPath();
      context.moveTo(left, y);
      context.lineTo(left + width, y);
      context.stroke();
      context.setLineDash([]);
    }
    const text = inside ? words : `${y < top ? "▲" : "▼"} ${words}`;
    const wide = context.measureText(text).width;
    const row = inside ? 0 : y < top ? edges.above++ : edges.below++;
    const at = inside ? Math.max(top + 8 * dpr, y - 8 * dpr) : y < top ? top + (8 + 14 * row) * dpr : top + height - (8 + 14 * row) * dpr;
    const ink = context.fillStyle;
    context.fillStyle = ground;
    context.globalAlpha = 0.8;
    context.fillRect(left + 4 * dpr, at - 7 * dpr, wide + 6 * dpr, 14 * dpr);
    context.globalAlpha = 1;
    context.fillStyle = ink;
    context.textAlign = "left";
    context.fillText(text, left + 7 * dpr, at);
  }
  context.restore();
}
