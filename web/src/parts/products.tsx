// The files that a job made, each with what it is for.

import type { Job, Product } from "../api.ts";
import { size } from "../format.ts";
import { runTexts } from "../texts/run.ts";

const words = runTexts.products;
const ORDER = Object.keys(words.about);

/** Files people ask for first come first; files we have no words for come last. */
function rank(product: Product): number {
  const place = ORDER.indexOf(product.name);
  return place === -1 ? ORDER.length : place;
}

export function Products({ job, products }: { job: Job; products: Product[] }) {
  const files = products.filter((product) => !product.name.includes("/")).sort((a, b) => rank(a) - rank(b));
  return (
    <section>
      <h2>{words.heading}</h2>
      {files.length === 0 ? (
        <p>{words.none}</p>
      ) : (
        <table class="products">
          <thead>
            <tr>
              <th scope="col">{words.file}</th>
              <th scope="col">{words.what}</th>
              <th scope="col" class="right">
                {words.size}
              </th>
            </tr>
          </thead>
          <tbody>
            {files.map((file) => (
              <tr key={file.name}>
                <th scope="row">
                  <a href={file.url} download={`${job.run}-${file.name}`} aria-label={words.download(file.name)}>
                    {file.name}
                  </a>
                </th>
                <td>{words.about[file.name] ?? ""}</td>
                <td class="right">{size(file.bytes)}</td>
              </tr>
            ))}
          </tbody>
        </table>
      )}
    </section>
  );
}
