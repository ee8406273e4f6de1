/* What the page knows: it shows what the gateway says on `api/events`, and decides nothing. What is not
   known is a dash. */
'use strict';

const DASH = '—';
/* Longer than the silence between two signs of life. */
const SILENCE_MAX = 15;
const TREND_SECONDS = 600, TREND_STEPS = 120, RATES_MAX = 300;

const $ = (id) => document.getElementById(id);
const seconds = () => Date.now() / 1000;

/* What was told. */
let gateway = null;
const buses = new Map(), devices = new Map();
/* What this page remembers of before: by bus its requests a second, by point its values. */
const rates = new Map(), trends = new Map();
/* Our clock less the gateway's: what has waited on its way is as much older. */
let offset = Infinity;
let is_live = false;
let heard_at = null;
