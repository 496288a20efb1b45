// Every word a person reads on our pages, in one place: what the first page needs here, the rest in `texts/`, a file for
// each part that is loaded by itself. Written for people who know pipes, not point clouds.

import { count, lengthMm, percent } from "./format.ts";
import type { JobState } from "./api.ts";

/** The upload that teaches the command line how to do the same. */
export const EXAMPLE_COMMAND = (origin: string) =>
  `curl -F file=@video.mp4 -F rig=@rig.toml -F asset=demo-pipe ${origin}/api/runs`;

export const texts = {
  product: "Stria",
  skip: "Skip to the content",
  menu: "Main",
  sending: (files: number, share: string) => (files === 1 ? `Sending: ${share}` : `Sending ${files} files: ${share}`),
  dropAnywhere: "Let go to send these files",
  nav: { runs: "Runs", defects: "Defects", live: "Live", queue: "Queue", settings: "Settings", send: "Send a run" },
  unknownPage: {
    heading: "There is no such page",
    body: (path: string) => `${path} is not one of Stria's addresses.`,
    back: "Go to the list of runs",
  },
  waiting: {
    runs: "Waiting for the list of runs…",
    run: "Waiting for this run…",
    products: "Waiting for the list of files…",
    log: "Waiting for the log…",
    part: "Loading…",
    list: "Loading…",
    reconnecting: "The connection to the server was lost. Trying again; what you see may be a few seconds old.",
  },
  problem: {
    expected: "Expected",
    tryAgain: "Try again",
    dismiss: "Dismiss",
    unreachable: "Stria's server did not answer. Check that it is running and that you are still on its network; this page tries again by itself.",
    uploadCut: "The connection broke before the whole file had arrived. Nothing was kept; send it again.",
  },
  loggedOut: {
    heading: "You are not logged in any more",
    body: "Your session is over, or somebody ended it. What you see stays, but nothing new comes and nothing can be changed.",
    logIn: "Log in",
    elsewhere: "Or log in on another tab and come back: this page then goes on by itself, with what you have typed.",
  },
  progressBar: "Progress of the measurement",
  frames: (frames: string) => `${frames} frames`,
  state: {
    queued: "Waiting",
    running: "Working",
    done: "Done",
    failed: "Failed",
    cancelled: "Cancelled",
    paused: "Paused",
  } satisfies Record<JobState, string>,
  runs: {
    title: "Runs",
    list: "Runs",
    count: (shown: number, more: boolean) => (more ? `${count(shown)} runs loaded, more below` : shown === 1 ? "1 run" : `${count(shown)} runs`),
    search: "Search runs",
    searchHint: "Asset, file, rig or note",
    state: "State",
    anyState: "Any state",
    asset: "Asset",
    anyAsset: "All assets",
    assetRuns: (name: string, runs: number) => `${name} (${count(runs)})`,
    from: "Recorded from",
    to: "until",
    sort: "Order",
    sorts: {
      "-created": "Newest first",
      created: "Oldest first",
      "-recorded": "Recorded last",
      recorded: "Recorded first",
      asset: "Asset A–Z",
      "-asset": "Asset Z–A",
    } as Record<string, string>,
    clear: "Clear filters",
    again: "Measure these again",
    nothing: "No run fits these filters.",
    loadingMore: "Loading more runs…",
    warnings: (warnings: number) => (warnings === 1 ? "1 warning" : `${count(warnings)} warnings`),
    previewOf: (name: string) => `Depth picture of ${name}`,
    at: (chainage: string) => `from ${chainage}`,
    rows: (share: number) => `line found ${percent(share)}`,
    travel: (mm: number) => lengthMm(mm),
    nothingMeasured: "nothing measured",
    quality: { good: "Good", fair: "With gaps", poor: "Poor" },
    emptyHeading: "No runs yet",
    emptyBody:
      "A run is one pass of a robot along a pipe or a wall: the video of its camera with the laser line in view. Drop one anywhere on this page, together with the rig file that says how camera and laser sit to each other.",
    emptyTry: "Nothing at hand? Make a realistic run of a damaged pipe and drop the two files it writes:",
    emptyTryCommand: "stria simulate pipe --out demo",
    emptyCommand: "The same upload from a robot or a script:",
    copy: "Copy",
    copied: "Copied",
  },
} as const;
