// What the page says: four captions with the paper's equations, and the scenes of the tour.

const i = name => `<mi>${name}</mi>`, o = sign => `<mo>${sign}</mo>`;
const sup = (name, sign) => `<msup>${i(name)}<mo>${sign}</mo></msup>`, sub = (name, index) => `<msub>${i(name)}<mi>${index}</mi></msub>`;
const math = (label, body) => `<math display="block" aria-label="${label}"><mrow>${body}</mrow></math>`;
const reward = (x, u) => `${i('r')}${o('(')}${x}${o(',')}${u}${o(')')}`;
const hat = `<msub><mover accent="true"><mi>x</mi><mo>^</mo></mover><mi>t</mi></msub>`;

export const LESSONS = [
  {
    title: '1. Segment',
    math: math('P of X plus given X minus, U minus, U plus and Z',
      `${i('P')}${o('(')}${sup('X', '+')}${o('|')}${sup('X', '−')}${o(',')}${sup('U', '−')}${o(',')}${sup('U', '+')}${o(',')}${i('Z')}${o(')')}`),
    text: 'A segment model predicts the next ten states X⁺ as a whole, from the ten before, the torques before, and the torques '
      + 'to come U⁺. Chained, ten segments make two seconds. Here these are the TSM of the paper and our recurrent TSM. The one-step '
      + 'model and the LSTM predict one state after the other.',
  },
  {
    title: '2. Code Z',
    math: math('Z is drawn from a standard normal distribution', `${i('Z')}${o('∼')}${i('N')}${o('(')}<mn>0</mn>${o(',')}${i('I')}${o(')')}`),
    text: 'Past and torques do not decide everything: a slightly different touch sends the object elsewhere. What the model cannot '
      + 'know it takes from eight random numbers for each segment, the code Z: another code, another future. The prediction '
      + 'drawn as the arm has Z\u00a0=\u00a00; the thin lines are 32 futures with random codes. Where they spread, the model is uncertain. '
      + 'The one-step model and the LSTM have no code, so they give one future and cannot say how sure they are.',
  },
  {
    title: '3. Code c',
    math: math('Maximise over the codes c 1 to c K the expected sum of rewards, with torques from the action prior',
      `<munder><mi>max</mi><mrow>${sub('c', '1')}<mo>…</mo>${sub('c', 'K')}</mrow></munder>${i('E')}<mo>[</mo><munder><mo>∑</mo><mi>t</mi></munder>`
      + `${reward(sub('x', 't'), sub('u', 't'))}<mo>]</mo>${o(',')}<mspace width="0.6em"/>${sub('u', 't')}${o('∼')}${i('P')}${o('(')}${sub('u', 't')}${o('|')}${sub('u', '1:t−1')}${o(',')}${i('c')}${o(')')}`),
    text: 'The planner tries 64 plans in the model, keeps the best, and tries again around them, six times (cross-entropy method); then it '
      + 'searches on, around its best plan and anew by turns, until nothing gets better in the mean over 32 futures. '
      + 'What it searches is your choice. The action prior is a second network: it turns codes c, eight numbers for each 0.2 s and not '
      + 'the Z above, into torques like those of the training data. Searching codes c, the planner finds only such torques; searching the '
      + 'torques themselves, it finds any.',
  },
  {
    title: '4. Exploitation',
    math: math('Gap: the sum of rewards of predicted states minus the sum of rewards of executed states',
      `<munder><mo>∑</mo><mi>t</mi></munder>${reward(hat, sub('u', 't'))}<mo>−</mo><munder><mo>∑</mo><mi>t</mi></munder>${reward(sub('x', 't'), sub('u', 't'))}`),
    text: 'A plan is chosen because its prediction is good, so the search finds the model’s mistakes: the model is fooled when a '
      + 'plan leads to torques or states that are rare in its training data, where a wrong prediction can look better than the '
      + 'truth. The gap, predicted minus executed return, says by how much: the third scene of the tour has a large one. The '
      + 'predicted return is the mean over the 32 futures, where there are any. A negative gap is the other mistake, a model that was too pessimistic.',
  },
];

export const TOUR = [
  {
    title: 'An easy push',
    link: '#task=push&model=rtsm&space=latent&replan=0&seed=1&arm=-1.17,-2.46&target=0.15,-0.04&block=-0.03,0.12',
    text: 'The recurrent TSM predicts, the planner picks torques, and MuJoCo executes them without looking again. '
      + 'The two agree: predicted and executed return are close, and the object arrives. Turn a knob of the code Z: another Z, '
      + 'another future of the same torques.',
  },
  {
    title: 'A bounce',
    link: '#task=push&model=rtsm&space=latent&replan=0&seed=1&arm=-0.94,1.8&target=0.16,-0.09&block=-0.05,-0.15',
    text: 'Here the object meets a wall and bounces off it. What happens then depends on the last millimetre, which the past does not '
      + 'tell: that is left to the code Z, and the thin lines, one for each random Z, spread. The model is less certain, and the '
      + 'execution falls among its futures rather than on their middle. Turn both knobs of Z.',
  },
  {
    title: 'A fooled one-step model',
    link: '#task=push&model=onestep&space=direct&replan=0&seed=1&arm=-1.17,-2.46&target=0.15,-0.04&block=-0.03,0.12',
    text: 'The first scene again, with two changes: a model that predicts one state at a time (it has no code Z, so no thin lines), and a '
      + 'planner free to choose any torques. It found a plan whose prediction is good and wrong: the predicted return is far above the executed one.',
  },
  {
    title: 'What the prior forbids',
    link: '#task=push&model=onestep&space=latent&replan=0&seed=1&arm=-1.17,-2.46&target=0.15,-0.04&block=-0.03,0.12',
    text: 'One of the two changes taken back: the same one-step model, but the planner searches codes c, which the action prior turns into torques like those of the '
      + 'training data. Here the gap is nearly gone, and the object arrives. Other random numbers can turn this round: over 100 '
      + 'targets this model is fooled about as often with codes.',
  },
  {
    title: 'Planning again',
    link: '#task=push&model=rtsm&space=latent&replan=1&seed=1&arm=-2.44,-0.85&target=0.04,0.08&block=-0.1,-0.11',
    text: 'A long way round. The planner looks every ten steps (0.2 s) at where the object really is, and plans the rest anew, so that an '
      + 'error does not grow: untick “Plan again” to see one plan, executed without looking. Each faint line is what an earlier plan '
      + 'predicted, from the dot where it was made.',
  },
];
