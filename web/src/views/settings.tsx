// Settings, a part at a time.

import type { ComponentType } from "preact";
import { useTitle } from "../hooks.ts";
import { lazy } from "../lazy.tsx";
import { Link } from "../router.tsx";
import { workTexts } from "../texts/work.ts";
import { UnknownView } from "./unknown.tsx";

const words = workTexts.settings;

const SECTIONS: Record<string, ComponentType> = {
  rigs: lazy(async () => (await import("../settings/rigs.tsx")).RigsSettings),
  recipes: lazy(async () => (await import("../settings/recipes.tsx")).RecipesSettings),
};

export function SettingsView({ section }: { section: string }) {
  useTitle(words.heading);
  const Section = SECTIONS[section];
  if (Section === undefined) return <UnknownView path={`/settings/${section}`} />;
  return (
    <>
      <h1>{words.heading}</h1>
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
