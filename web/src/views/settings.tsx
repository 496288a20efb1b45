// Settings, a part at a time.

import type { ComponentType } from "preact";
import { useTitle } from "../hooks.ts";
import { lazy } from "../lazy.tsx";
import { Link } from "../router.tsx";
import { Who } from "../settings/who.tsx";
import { workTexts } from "../texts/work.ts";
import { UnknownView } from "./unknown.tsx";

const words = workTexts.settings;

const SECTIONS: Record<string, ComponentType> = {
  rigs: lazy(async () => (await import("../settings/rigs.tsx")).RigsSettings),
  recipes: lazy(async () => (await import("../settings/recipes.tsx")).RecipesSettings),
  tokens: lazy(async () => (await import("../settings/tokens.tsx")).TokensSettings),
  retention: lazy(async () => (await import("../settings/retention.tsx")).RetentionSettings),
};

export function SettingsView({ section }: { section: string }) {
  useTitle(words.heading);
  const Section = SECTIONS[section];
  if (Section === undefined) return <UnknownView path={`/settings/${section}`} />;
  return (
    <>
      <h1>{words.heading}</h1>
      <Who />
      <nav class="tabs" aria-label={words.sectionsLabel}>
        {Object.keys(SECTIONS).map((name) => (
          <Link key={name} to={`/settings/${name}`} current={name === section}>
            {words.sections[name] ?? name}
          </Link>
        ))}
      </nav>
      <Section key={section} />
    </>
  );
}
