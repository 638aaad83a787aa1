/**
 * The commands of the page, the slices and the events that it receives, by their names; written by
 * python -m testing.workbench.protocol_text.
 */

export interface Commands {
  acquire_check: { plan: Record<string, unknown> };
  acquire_connect: { plan: Record<string, unknown> };
  acquire_disconnect: Record<string, never>;
  acquire_jog: { pan_deg: number; tilt_deg: number };
  acquire_keep: { plan: Record<string, unknown> };
  acquire_open: { run?: string | null };
  acquire_pause: Record<string, never>;
  acquire_photos: { run: string };
  acquire_ports: Record<string, never>;
  acquire_resume: Record<string, never>;
  acquire_start: { plan?: Record<string, unknown> | null; resume?: string | null };
  acquire_stop: Record<string, never>;
  acquire_take_over: Record<string, never>;
  add_embedded: { images: number[] };
  add_measurement: { kind: "point" | "distance" | "polyline" | "angle" | "area" | "height"; places: Record<string, unknown>[]; station?: string };
  add_pick: { photo: string; kind: "point" | "line"; scan: number[][]; photo_uv: number[][]; station?: string | null };
  add_tie: { photos: string[]; uv: number[][]; sigma_px?: number };
  adjust: { photos?: string[] | null };
  apply_smoothing: { photo: string; rev: string; edges?: boolean };
  call_me: { name: string };
  check_at_stations: Record<string, never>;
  discard_files: { files: string[] };
  discard_smoothing: Record<string, never>;
  draw_line: { photo: string; uv: number[][]; line?: string | null; sigma_px?: number };
  draw_line_in_scan: { scan: number[][]; station?: string; line?: string | null; sigma_rad?: number; sigma_px?: number };
  duplicate_project: { wanted: string };
  erase_line: { line: string; photo?: string | null };
  export: { targets?: string[] | null; photos?: string[] | null; frame?: "scanner" | "world"; full?: boolean; crop?: "none" | "photo"; last_solved?: boolean; folder?: string | null; force?: boolean };
  export_targets: { targets?: string[] | null; photos?: string[] | null; frame?: "scanner" | "world"; full?: boolean; crop?: "none" | "photo"; last_solved?: boolean };
  follow: { client?: string | null };
  forget_project: { wanted: string };
  go_to: { n: number };
  hold_camera: { camera: string; held: boolean };
  hover_pick: { pick?: string | null };
  job_control: { action: string; value?: number | null; job?: string | null };
  line_ends_as_ties: { line: string };
  list_jobs: { outcome?: "failed" | "refused" | "waiting" | "accepted" | null; words?: string };
  list_projects: Record<string, never>;
  list_served: Record<string, never>;
  look: { viewpoint: "start" | "overview" | "scanner" | "camera" };
  measure: { kind: "point" | "distance" | "polyline" | "angle" | "area" | "height"; places: Record<string, unknown>[]; station?: string };
  new_project: { name?: string | null; files?: string[] | null; sure?: boolean };
  open_files: { files: string[]; scan?: "replace" | "frames" | "stations" | null; photo?: string | null; reading?: Record<string, unknown> | null };
  open_job: { wanted: string; sure?: boolean };
  open_project: { wanted?: string | null; folder?: string | null; sure?: boolean };
  open_sample: { sure?: boolean };
  open_served: { what: string; path?: string | null; paths?: string[] | null; photo?: string | null; reading?: Record<string, unknown> | null; scan?: "replace" | "frames" | "stations" | null };
  place_camera: { photo: string; camera_from_scanner?: number[][] | null; start?: "pose" | "scanner" | "view" | null; shift_m?: number[] | null; turn_deg?: number[] | null };
  place_station: { station: string; place?: Record<string, unknown> | null };
  point: { side: "scan" | "photo"; photo?: string | null; view?: number; uv?: number[] | null };
  predict: { photo: string; side: "scan" | "photo"; scan?: number[][] | null; photo_uv?: number[][] | null };
  preview_smoothing: { photo: string; show?: "before" | "after" | "difference" };
  probe: { scan: number[] };
  read_only_link: Record<string, never>;
  redo: { n?: number | null };
  refine: { photo: string; camera_from_scanner?: number[][] | null };
  register_all: { photos?: string[] | null };
  register_stations: { poses?: "keep" | "refine" | "search" };
  reject: { photo: string; above: number; by?: "depth" | "px" };
  remove_lines: { lines: string[] };
  remove_measurements: { measurements: string[] };
  remove_photo: { photo: string };
  remove_picks: { photo: string; picks: string[] };
  remove_station: { station: string };
  remove_ties: { ties: string[] };
  rename: { name: string };
  rename_measurement: { measurement: string; name: string };
  restore_ranges: { station?: string };
  run: { photo: string; job: string };
  sample_line: { scan: number[][] };
  scan_of: { station?: string };
  set_camera: { photo: string; focal_35mm?: number | null; focal_mm?: number | null; sensor_mm?: number | null; focal_px?: number | null; model?: "equirectangular" | null };
  set_model: { texture?: string; z_buffer?: boolean; detail?: string; cameras?: boolean; matches?: boolean; rays?: boolean; residuals?: boolean; hidden_stations?: string[] };
  set_part: { photos: string[]; part: "free" | "held" | "out" };
  set_pick: { photo: string; pick: string; scan?: number[][] | null; photo_uv?: number[][] | null; on?: boolean | null; weight?: number | null };
  set_settings: { [NAME: string]: unknown };
  set_station: { photo: string; station?: string };
  show_photo: { photo: string };
  show_station: { station: string };
  show_view: { side: "scan" | "photo"; photo?: string | null; view?: number; zoom: number; centre?: number[] | null };
  snap: { side: "scan" | "photo"; ends: number[][]; photo?: string | null; view?: number; px_per_screen?: number };
  switch_picks: { photo: string; picks: string[]; on: boolean };
  undo: { n?: number | null };
  use_stage: { photo: string; stage: string };
  where: { photo: string; scan: number[] };
  write_report: { photo: string };
}

export type Slices = {
  acquisition: Acquisition;
  beside: ReadScan | LostScan | null;
  drawn_lines: DrawnLine[];
  drawn_ties: DrawnTie[];
  embedded: EmbeddedPicture[];
  formats: FileFormats[];
  history: History;
  job: Job | null;
  limits: Limits;
  measured: Measured[];
  measurements: Measurement[];
  model: Model;
  partner: Partner;
  people: People;
  photos: Photo[];
  progress: Progress;
  project: Project;
  reading: Record<string, ReadingField>;
  scan: ReadScan | LostScan | null;
  served: Served | null;
  settings: Record<string, Setting>;
  shown: string | null;
  smoothing: Smoothing;
  stations: Stations | null;
  survey: Survey | null;
  waiting: WaitingFile[];
  [name: `audit:${string}`]: Audit | null;
  [name: `corners:${string}`]: Corners | null;
  [name: `judged:${string}`]: Judged;
  [name: `outline:${string}`]: Outline | null;
  [name: `picks:${string}`]: Pick[];
  [name: `poses:${string}`]: Poses;
  [name: `progress:${string}`]: Progress;
  [name: `self_test:${string}`]: SelfTest | null;
  [name: `solving:${string}`]: Solving;
  [name: `ties:${string}`]: number[][] | null;
};

export type Events = {
  cursor: CursorEvent;
  export_ready: ExportReadyEvent;
  flown: FlownEvent;
  hover: HoverEvent;
  notice: NoticeEvent;
  placement: PlacementEvent;
  project: ProjectEvent;
  simplex: SimplexEvent;
  view: ViewEvent;
};

export type AcquiredRun = {
  name: string;
  done: number;
  total: number;
  complete: boolean;
  photos: number;
};

export type Acquisition = {
  state: "off" | "connecting" | "disconnecting" | "ready" | "jogging" | "running" | "paused" | "fault";
  offered: boolean;
  said: string;
  driver: Driver | null;
  devices: Devices | null;
  plan: PlanFields | null;
  at_deg: number[] | null;
  done: number;
  total: number;
  seconds_left: number;
  complete: boolean;
  run: string;
  picture: string | null;
  points: number;
  runs: AcquiredRun[];
};

export type Advice = {
  uv: number[];
  ray: number[];
  sentence: string;
};

export type Audit = {
  outcome: "right" | "wrong" | "undecidable";
  sentence: string;
  p_value: number | null;
  false_alarm: number;
  correction: number[] | null;
  covariance: number[][] | null;
  camera_from_scanner: number[][] | null;
  power: PowerFields;
  judged: string;
};

export type CameraFields = {
  folder?: string;
  device?: number | null;
  mount: number[][] | null;
  trigger?: Record<string, unknown>;
};

export type Choice = {
  value: string;
  label: string;
};

export type Corners = {
  scan: number[][];
  photo: number[][];
};

export type CursorEvent = {
  client: string;
  side: "scan" | "photo";
  view: number;
  photo: string | null;
  station: string;
  event: "cursor";
  uv: number[] | null;
};

export type Devices = {
  unit: string;
  simulated: boolean;
  lowest_deg: number[];
  highest_deg: number[];
  step_deg: number[];
  scanner: string | null;
  has_intensity: boolean;
};

export type Drawing = {
  ends: (number[] | null)[];
  lines: (number[] | null)[][];
};

export type DrawnLine = {
  id: string;
  photos: string[];
  uv: number[][][];
  sigma_px: number;
  in_scan: LineInScan | null;
  agrees: boolean | null;
  residuals_px: Record<string, number>;
  scan_residual: string | null;
  reason: string;
};

export type DrawnTie = {
  id: string;
  track: string;
  photos: string[];
  uv: number[][];
  sigma_px: number;
  agrees: boolean | null;
  residual_px: number | null;
  reason: string;
};

export type Driver = {
  id: string;
  name: string;
};

export type EmbeddedPicture = {
  index: number;
  name: string;
  said: string;
  usable: boolean;
  taken: boolean;
};

export type ExportReadyEvent = {
  event: "export_ready";
  targets: string[];
  name: string;
  url: string;
};

export type FileFormats = {
  kind: "scan" | "photo" | "camera" | "matches";
  label: string;
  names: string[];
  extensions: string[];
};

export type Finding = {
  what: string;
  level: "good" | "fair" | "poor";
  sentence: string;
  what_to_do: string;
};

export type FlownEvent = {
  event: "flown";
  photo: string;
};

export type FocalPhotoCamera = {
  model: string;
  width: number;
  height: number;
  distortion: number[];
  calibrated: boolean;
  said: string;
  short: string;
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  window?: undefined;
};

export type History = {
  at: number;
  entries: HistoryEntry[];
};

export type HistoryEntry = {
  n: number;
  label: string;
  author: string;
  when: string;
};

export type HoverEvent = {
  event: "hover";
  client: string;
  photo: string | null;
  pick: string;
};

export type ImageOutcome = {
  outcome: "verified" | "contradicted" | "undecidable";
  sentence: string;
};

export type Job = {
  id: string;
  kind: string;
  label: string;
  photo: string;
  author: string;
  state: "waiting" | "running" | "paused" | "done" | "failed" | "stopped";
  done: number;
  total: number;
  said: string;
  seconds: number;
  can: ("pause" | "stop" | "speed" | "step")[];
  speed: number;
  steps: JobStep[];
  waiting: WaitingJob[];
};

export type JobStep = {
  name: string;
  label: string;
  seconds: number;
  said: string;
};

export type Judged = {
  stage: "linear" | "constrained_linear" | "simplex" | "simplex_outliers_removed" | "robust" | "refined" | "auto" | "thesis" | "survey" | "carried" | null;
  by_pick: Record<string, JudgedPick>;
  thresholds: Thresholds;
  predicted: Record<string, (number[] | null)[]>;
  lines: Record<string, SampledLine>;
  lengths: Record<string, JudgedLength>;
  losses: string[];
  cautions: string[];
};

export type JudgedLength = {
  length_m: number;
  scan_range_m: number | null;
  difference_m: number | null;
  tolerance_m: number;
  state: "compared" | "no return" | "depth edge" | "outside the scan";
  beyond: boolean;
};

export type JudgedPick = {
  px: number | null;
  mm: number | null;
  depth_m: number | null;
  inlier: boolean | null;
  agrees: boolean | null;
  influence: number | null;
};

export type Limits = {
  upload_bytes: number;
  photos: number;
};

export type LineInScan = {
  station: string | null;
  name: string;
  xyz: number[][];
  sigma: string;
};

export type LostScan = {
  id: string;
  name: string;
  files: string[];
  notes: string[];
  views: ScanView[];
  error: string;
  grid?: undefined;
  rows?: undefined;
  columns?: undefined;
  returns?: undefined;
  world?: undefined;
  has_color?: undefined;
  has_intensity?: undefined;
  strip?: undefined;
};

export type LostStage = {
  stage: "linear" | "constrained_linear" | "simplex" | "simplex_outliers_removed" | "robust" | "refined" | "auto" | "thesis" | "survey" | "carried";
  label: string;
  accepted: boolean;
  verdict: string;
  stale: string;
  summary: Summary;
  image?: undefined;
  findings?: undefined;
  uncertainty?: undefined;
  check?: undefined;
  check_pick?: undefined;
  advice?: undefined;
  absent?: undefined;
  method?: undefined;
  evidence?: undefined;
  reasons?: undefined;
  wants_frames?: undefined;
  note?: undefined;
  parameters?: undefined;
  matches?: undefined;
  inliers?: undefined;
  median_px?: undefined;
  rms_px?: undefined;
  rms_depth_m?: undefined;
  cost?: undefined;
  centre?: undefined;
  in_world?: undefined;
  focal_px?: undefined;
  camera_sigmas?: undefined;
  seconds?: undefined;
  regions?: undefined;
  steps?: undefined;
};

export type Measured = {
  value: string;
  interval: string;
  notes: string[];
  refusal: string;
  drawn: Drawing | null;
  in_photo: Record<string, Drawing>;
  id: string;
};

export type Measurement = {
  id: string;
  station: string;
  name: string;
  kind: "point" | "distance" | "polyline" | "angle" | "area" | "height";
  places: MeasurementPlace[];
};

export type MeasurementPlace = {
  photo?: string;
  uv?: number[];
  sigma_px?: number;
  ray?: number[];
  sigma_rad?: number;
};

export type Model = {
  texture: string;
  z_buffer: boolean;
  detail: "coarse" | "standard" | "dense";
  cameras: boolean;
  matches: boolean;
  rays: boolean;
  residuals: boolean;
  hidden_stations: string[];
  rev: string;
  accepted: boolean;
  choices: TextureOption[];
  sheet: Sheet | null;
};

export type MountFields = {
  xyz_m: number[];
  rpy_deg: number[];
  base?: string | number[];
  base_sigma_deg?: number[];
};

export type NextStep = {
  sentence: string;
  action: "" | "solve" | "verify" | "register" | "use_stage" | "frames" | "export";
  stage: "linear" | "constrained_linear" | "simplex" | "simplex_outliers_removed" | "robust" | "refined" | "auto" | "thesis" | "survey" | "carried" | null;
};

export type NoticeEvent = {
  event: "notice";
  level: "info" | "warn" | "bad";
  text: string;
  photo?: string;
};

export type Outline = {
  rays: number[][];
  registered: boolean;
};

export type PanoramaCamera = {
  model: string;
  width: number;
  height: number;
  distortion: number[];
  calibrated: boolean;
  said: string;
  short: string;
  window: number[] | null;
  fx?: undefined;
  fy?: undefined;
  cx?: undefined;
  cy?: undefined;
};

export type Parameter = {
  name: string;
  unit: string;
  value: string;
  sigma: string;
};

export type Partner = {
  station: string;
  choices: PartnerChoice[];
};

export type PartnerChoice = {
  station: string;
  name: string;
  index: number;
  sees: number | null;
};

export type People = {
  count: number;
  you: string;
  clients: Person[];
};

export type Person = {
  id: string;
  name: string;
  colour: number;
  photo: string | null;
  follows: string | null;
  read_only: boolean;
};

export type Photo = {
  id: string;
  name: string;
  width: number;
  height: number;
  camera: FocalPhotoCamera | PanoramaCamera | null;
  notes: string[];
  thermal: boolean;
  state: "empty" | "solved" | "accepted" | "refused" | "stale";
  stale?: string;
  light?: "verified" | "matches_only" | "given" | "not_accepted" | "out_of_date";
  light_words?: string;
  position?: string;
  rev: string;
  part: "free" | "held" | "out";
  station: string;
  stated_pose?: number[][];
  camera_error?: string;
  error?: string;
};

export type Pick = {
  id: string;
  number: number;
  kind: "point" | "line";
  scan: number[][];
  photo: number[][];
  on: boolean;
  weight: number;
  origin: string;
  name?: string;
};

export type PlacementEvent = {
  event: "placement";
  photo: string;
  camera_from_scanner: number[][];
};

export type PlanFields = {
  version: number;
  unit: UnitFields;
  scanner: ScannerFields;
  camera: CameraFields | null;
  mode: "sweep" | "mosaic";
  pan_deg: number[];
  tilt_deg: number[];
  settle_s: number;
  continuous: boolean;
  passes: number;
  mount: MountFields;
};

export type Poses = {
  shown: "linear" | "constrained_linear" | "simplex" | "simplex_outliers_removed" | "robust" | "refined" | "auto" | "thesis" | "survey" | "carried" | null;
  stages: (SolvedStage | LostStage)[];
};

export type PowerFields = {
  rotation_rad: number[][];
  position_m: number[][];
  seen_with_probability: number;
  smallest_rotation_rad: number | null;
  smallest_position_m: number | null;
};

export type PreviewedRange = {
  id: string;
  ray: number[];
  uv: number[] | null;
  before_m: number;
  after_m: number;
  sigma_m: number;
  edge: boolean;
};

export type Progress = {
  steps: WorkStep[];
  needed: string;
  next_action: string;
  exported: Record<string, "scanner" | "world">;
};

export type Project = {
  id: string;
  start: boolean;
  name: string;
  folder: string;
  saved_at: string;
  unsaved: boolean;
  unsaved_why: string;
  amiss: string;
  undo: string | null;
  redo: string | null;
  opened: string;
};

export type ProjectEvent = {
  event: "project";
  id: string;
  name: string;
  by: string;
};

export type ReadScan = {
  id: string;
  grid: string;
  name: string;
  files: string[];
  rows: number;
  columns: number;
  returns: number;
  notes: string[];
  world: WorldPlace | null;
  has_color: boolean;
  has_intensity: boolean;
  views: ScanView[];
  strip: Strip | null;
  error?: undefined;
};

export type ReadingField = {
  label: string;
  hint: string;
  example: string;
  kind: "whole" | "coordinates" | "names" | "text" | "duration" | "temperature_unit" | "switch";
};

export type SampledLine = {
  scan_samples: [number[], boolean][];
  sampled: number;
  used: number;
};

export type ScanView = {
  label: string;
  width: number;
  height: number;
  f: number;
  cx: number;
  cy: number;
  rotation: number[];
};

export type ScannerFields = {
  kind: "scip2" | "folder" | "packets";
  port?: string;
  baud?: number;
  lines?: number;
  udp_port?: number;
  host?: string;
  sensor_file?: string;
  folder?: string;
  timeout_s?: number;
  fov_deg?: number[];
  trigger?: Record<string, unknown>;
};

export type SelfTest = {
  sentence: string;
  advice: string;
  counts: string;
  rows: SelfTestRow[];
};

export type SelfTestRow = {
  kind: "right" | "start" | "wrong";
  right: boolean;
  accepted: boolean;
  error_mm: number | null;
  error_deg: number | null;
  error_px: number | null;
  off_deg: number;
  seconds: number;
};

export type Served = {
  label: string;
  files: ServedFile[];
};

export type ServedFile = {
  path: string;
  size: number;
  kind: "scan" | "photo" | "camera" | "pose" | "matches" | "results";
};

export type Setting = {
  value: string | number | boolean | null;
  label: string;
  kind: "number" | "choice" | "switch";
  least: number | null;
  most: number | null;
  step: number | null;
  whole: boolean;
  empty: boolean;
  choices: Choice[];
  unit: string;
  step_of: "corners" | "match" | "cull" | "constrained" | "lines" | "simplex" | "reject" | "robust" | "all";
  said: string;
};

export type Sheet = {
  photo: string;
  centre: number[];
  distance: number;
  columns: number;
  corners: (number[] | null)[];
};

export type SimplexEvent = {
  event: "simplex";
  photo: string;
  iteration: number;
  move: string;
  parameters: number[];
  camera_from_scanner: number[][];
  cost: number;
  inliers: number;
  matches: number;
  residual: string;
  round: number;
  predicted: Record<string, (number[] | null)[]>;
  last: boolean;
};

export type Smoothing = {
  station: string;
  replaced: number;
  sentence: string;
  preview: SmoothingPreview | null;
};

export type SmoothingPreview = {
  photo: string;
  name: string;
  station: string;
  show: "before" | "after" | "difference";
  rev: string;
  stale: string;
  nothing: string;
  ranges: PreviewedRange[];
};

export type SolvedStage = {
  image?: ImageOutcome;
  findings?: Finding[];
  uncertainty?: string;
  check?: string;
  check_pick?: string | null;
  advice?: Advice[];
  absent?: Record<string, string>;
  stage: "linear" | "constrained_linear" | "simplex" | "simplex_outliers_removed" | "robust" | "refined" | "auto" | "thesis" | "survey" | "carried";
  label: string;
  method: string;
  accepted: boolean;
  evidence: "image" | "ties" | "rig" | "statistics" | "given" | "none";
  verdict: string;
  reasons: string[];
  wants_frames: boolean;
  stale: string;
  summary: Summary;
  note: string;
  parameters: Parameter[];
  matches: number;
  inliers: number;
  median_px: number | null;
  rms_px: number | null;
  rms_depth_m: number | null;
  cost: number | null;
  centre: number[];
  in_world: string | null;
  focal_px: number;
  camera_sigmas: Record<string, number>;
  seconds: number;
  regions: number[][];
  steps: StageStep[];
};

export type Solving = {
  busy: boolean;
  sentence: string;
};

export type StageStep = {
  name: string;
  label: string;
  seconds: number;
};

export type Station = {
  id: string | null;
  name: string;
  files: string[];
  index: number;
  colour: string | null;
  state: "waiting" | "fixed" | "registered" | "kept" | "stated" | "out";
  sigma_mm: number | null;
  sigma_deg: number | null;
  place: StationPlace | null;
  rough: boolean;
};

export type StationCheck = {
  photo: string;
  name: string;
  station: string;
  outcome: "verified" | "contradicted" | "undecidable";
  sentence: string;
  fraction: number | null;
  stale: boolean;
};

export type StationLoop = {
  stations: string[];
  error_mm: number;
  error_deg: number;
};

export type StationPair = {
  first: string;
  second: string;
  verdict: "verified" | "ambiguous" | "refused";
  reasons: string[];
  overlap: number | null;
  sigma_mm: number | null;
  sigma_deg: number | null;
};

export type StationPlace = {
  x: number;
  y: number;
  z: number;
  yaw_deg: number;
};

export type Stations = {
  done: boolean;
  status: string;
  missing: string;
  stations: Station[];
  stale: boolean;
  registered: boolean;
  pairs: StationPair[];
  loops: StationLoop[];
  reasons: string[];
  checks: StationCheck[];
};

export type Strip = {
  low: number;
  high: number;
};

export type Summary = {
  light: "verified" | "matches_only" | "given" | "not_accepted" | "out_of_date";
  words: string;
  line: string;
  position: string;
  pixels: string;
  matches: string;
  next_step: NextStep;
  other: NextStep | null;
};

export type Survey = {
  accepted: number;
  photos: SurveyPhoto[];
  cameras: SurveyCamera[];
  scans: SurveyScan[];
  chi2_per_dof: number | null;
  sigma_px: number | null;
  since: string;
};

export type SurveyCamera = {
  id: string;
  focal_px: number | null;
  sigma_px: number | null;
  width: number | null;
  height: number | null;
  photos: string[];
  used: number;
  median_px: number | null;
  worst: WorstPhoto | null;
  held: boolean;
};

export type SurveyPhoto = {
  id: string;
  name: string;
  verdict: string;
  accepted: boolean;
  reasons: string[];
  ties: number;
  ties_left_out: number;
  median_px: number | null;
  partners: string[];
  camera: string;
  sigma_m: number | null;
  position: string | null;
  angle: string | null;
  moved: string | null;
  changed: boolean;
};

export type SurveyScan = {
  name: string;
  state: "fixed" | "placed" | "not connected";
  position: string | null;
  angle: string | null;
};

export type TextureOption = {
  value: string;
  label: string;
  usable: boolean;
  said: string;
};

export type Thresholds = {
  depth: number | null;
  px: number | null;
};

export type UnitFields = {
  kind: "flir-ptu" | "pelco-d" | "onvif";
  port: string;
  baud?: number;
  signs: number[];
  address?: number;
  user?: string;
  range_deg?: number[][];
  speed_deg_s?: number;
};

export type ViewEvent = {
  client: string;
  side: "scan" | "photo";
  view: number;
  photo: string | null;
  station: string;
  event: "view";
  centre: number[] | null;
  zoom: number;
};

export type WaitingFile = {
  id: string;
  name: string;
  size: number;
  kind: "scan" | "photo" | "camera" | "pose" | "matches" | "results" | "part";
  said: string;
  lacks: string[];
  takes: string[];
  scans?: string[];
};

export type WaitingJob = {
  id: string;
  label: string;
  photo: string;
  author: string;
};

export type WorkStep = {
  name: "match" | "solve" | "judge" | "export";
  done: boolean;
  status: string;
  missing: string;
};

export type WorldPlace = {
  position: string;
  heading: string;
  tilt: string;
};

export type WorstPhoto = {
  id: string;
  name: string;
  median_px: number;
};
