export interface components { schemas: {
  RunSource: { filename: string; bytes: number; sha256: string; fps?: number | null; url: string };
  Run: { id: string; asset: string; chainage_mm: number; direction: "forward" | "backward"; recorded_at: string; created_at: string; note: string; rig: string; source: components["schemas"]["RunSource"]; state: components["schemas"]["JobState"]; job: components["schemas"]["Job"]; };
  JobState: "queued" | "running" | "done" | "failed" | "cancelled";
  Priority: "live" | "upload" | "batch";
  Job: { id: string; run: string; state: components["schemas"]["JobState"]; cancelling: boolean; stage: string; progress: number; frames: number; frames_total?: number | null; frames_per_s: number; time_left_s?: number | null; attempt: number; priority: components["schemas"]["Priority"]; rig: string; recipe: string; warnings: string[]; error?: components["schemas"]["Problem"] | null; quality?: unknown; created_at: string; started_at?: string | null; finished_at?: string | null; next_attempt_at?: string | null };
  LogLine: { number: number; at: string; attempt: number; text: string };
  Product: { name: string; bytes: number; sha256: string; content_type: string; url: string };
  RecordingSegment: { number: number; generation: number; bytes: number; url: string };
  Recording: { segments: components["schemas"]["RecordingSegment"][]; complete: boolean; recording?: string | null };
  Rig: { name: string; created_at: string; sha256: string; rig: unknown; toml: string };
  Recipe: { name: string; default: boolean; toml: string };
  RunPage: { items: components["schemas"]["Run"][]; next_cursor?: string | null };
  JobPage: { items: components["schemas"]["Job"][]; next_cursor?: string | null };
  LogPage: { items: components["schemas"]["LogLine"][]; next_cursor?: string | null };
  ProductPage: { items: components["schemas"]["Product"][]; next_cursor?: string | null };
  RigPage: { items: components["schemas"]["Rig"][]; next_cursor?: string | null };
  Problem: { type: string; title: string; status?: number | null; detail: string; field?: string | null; expected?: string | null; retryable: boolean };
} }
